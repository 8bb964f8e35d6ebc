"""Ground truth beside a run: JSON lines with the room and the true instances of each keyframe.

A line is ``{"run_id", "keyframe_id", "room": text or null, "instances": [id or null, …]}``, the
instances parallel to the envelope's detections (null: a false positive). Plain or gzipped. The
truth never goes into a log.
"""

import gzip
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, open_file, parse_json
from eventsrc.envelope.model import RunId

Key = tuple[str, int]
"""run_id and keyframe_id."""


class TrueKeyframe(BaseModel):
    """The truth of one keyframe, as in the file."""

    model_config = ConfigDict(frozen=True, strict=True)

    run_id: RunId
    keyframe_id: int
    room: str | None
    instances: list[str | None]


@dataclass(frozen=True, slots=True)
class Truth:
    """All truth that was given, by keyframe."""

    keyframes: Mapping[Key, TrueKeyframe]

    def room(self, key: Key) -> str | None:
        """The room of a keyframe; None when there is none or it is not known."""
        found = self.keyframes.get(key)
        return None if found is None else found.room

    def instance(self, key: Key, index: int) -> str | None:
        """The true instance of a keyframe's detection; None for a false positive."""
        found = self.keyframes.get(key)
        if found is None or index >= len(found.instances):
            return None
        return found.instances[index]


_MAX_LINE_BYTES: Final = 16 * 1024 * 1024
"""A longer line is read as several, which are no JSON."""


def read_truth(paths: Iterable[Path]) -> Truth:
    """Read truth files. Raises MisuseError naming file and line."""
    return Truth({(line.run_id, line.keyframe_id): line for path in paths for line in _read(path)})


def _read(path: Path) -> list[TrueKeyframe]:
    try:
        with open_file(path) as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            stream: BinaryIO = gzip.GzipFile(fileobj=file) if packed else file  # type: ignore[assignment]
            lines = enumerate(iter(lambda: stream.readline(_MAX_LINE_BYTES), b""), start=1)
            return [_parse(path, number, line) for number, line in lines if line.strip()]
    except FileFault as fault:
        raise MisuseError(f"--truth {path}: {fault}") from None
    except (EOFError, gzip.BadGzipFile, zlib.error):
        raise MisuseError(f"--truth {path}: the gzip stream is cut short or damaged") from None
    except OSError as error:
        raise MisuseError(f"--truth {path}: {error.strerror or error}") from None


def _parse(path: Path, number: int, line: bytes) -> TrueKeyframe:
    try:
        return TrueKeyframe.model_validate(parse_json(line))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise MisuseError(
            f"--truth {path}, line {number}: {place}: {first['msg'].lower()}"
        ) from None
    except ValueError as error:
        raise MisuseError(f"--truth {path}, line {number}: not JSON: {error}") from None
