"""What a file or folder to import is: a bag of ROS 2, MCAP, another log, or JSON lines."""

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Final

from eventsrc.base.errors import MisuseError
from eventsrc.log.format import list_segments

from .bag_files import MCAP_MAGIC, METADATA, START_BYTES, is_bag, is_file_of_a_bag
from .bag_streams import BagOptions
from .json_lines import JsonLines
from .ros_bags import RosBag
from .sources import McapFile, OtherLog, Source

STDIN: Final = "-"


def check_sources(names: Sequence[str]) -> None:
    """Raise MisuseError for the first source that cannot be read; call it before a log is
    created."""
    for name in names:
        if name == STDIN:
            continue
        path = Path(name)
        try:
            path.stat()
            is_source = not path.is_dir() or is_bag(path) or bool(list_segments(path))
        except FileNotFoundError:
            raise MisuseError(f"{name}: no such file; check the path") from None
        except OSError as error:
            raise MisuseError(f"{name}: {error.strerror or error}; check the path") from None
        if not is_source:
            raise MisuseError(f"{name}: neither a bag of ROS 2 nor a log; check the path")


def open_source(name: str, files: ExitStack, bags: BagOptions) -> Source:
    """Open the source ``name``: a folder is a bag of ROS 2 or a log, ``-`` is standard input, a
    file is JSON lines, MCAP or part of a bag. Raises MisuseError."""
    if name != STDIN and Path(name).is_dir():
        return RosBag(Path(name), files, bags) if is_bag(Path(name)) else OtherLog(Path(name))
    if Path(name).name == METADATA:
        raise MisuseError(f"{name}: it describes a bag of ROS 2; give its folder")
    file: BinaryIO
    try:
        if name == STDIN:
            label, file, size = "standard input", sys.stdin.buffer, None
        else:
            path, label = Path(name), name
            file, size = files.enter_context(path.open("rb")), path.stat().st_size
        start: bytes = file.peek(START_BYTES)  # type: ignore[attr-defined]
    except OSError as error:
        raise MisuseError(f"{name}: {error.strerror or error}; check the path") from None
    if name != STDIN and is_file_of_a_bag(start):
        return RosBag(Path(name), files, bags)
    if start.startswith(MCAP_MAGIC):
        return McapFile(label, file, size)
    return JsonLines(label, file, size, start)


def is_ros(name: str) -> bool:
    """Whether a source is a bag of ROS 2, or a file of one. Raises MisuseError if it cannot be
    read. A pipe, which can be read only once, is none."""
    path = Path(name)
    if path.is_dir():
        return is_bag(path)
    if name == STDIN or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return is_file_of_a_bag(file.read(START_BYTES))
    except OSError as error:
        raise MisuseError(f"{name}: {error.strerror or error}; check the path") from None
