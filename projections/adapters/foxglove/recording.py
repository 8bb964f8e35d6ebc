"""A recording of how a map came about, an MCAP file for Foxglove."""

import io
import os
from pathlib import Path
from typing import Any

from foxglove import Context, open_mcap

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.user_files import OutputFile, written_whole
from projections.fold.deltas import KeyframeAdded, MapGiven
from projections.map.phrases import change_lines
from projections.map.scenes import RecordedFold

from .topics import MapTopics


def write_recording(fold: RecordedFold, path: Path, *, everything: bool = False) -> int:
    """Record a fold's events and the maps that they make; returns the number of scenes.

    Scenes have Objects that are not confirmed only with ``everything``. The same log gives the same
    bytes. Raises FoldError at an event that cannot be folded, and what `written_whole` raises.
    """
    context, scenes = Context(), 0
    with written_whole(path) as file:
        if not file.seekable():
            raise MisuseError(f"{path}: an MCAP recording goes to a file, not a pipe; choose one")
        sink = _Sink(file)
        with open_mcap(sink, context=context):
            topics = MapTopics(context, everything=everything)
            for event, now, deltas, is_scene in fold:
                topics.event(event, now)
                topics.changes(change_lines(fold.view, deltas), now)
                for delta in deltas:
                    if isinstance(delta, MapGiven):
                        topics.walls(fold.view, delta, now)
                if any(isinstance(delta, KeyframeAdded) for delta in deltas):
                    topics.robot(fold.view, now)
                if is_scene:
                    topics.scene(fold.view, fold.merges, now)
                    scenes += 1
                sink.check()
        sink.check()
    return scenes


class _Sink(io.RawIOBase):
    """What the SDK writes to. It would print a line for each message after a failed write, so the
    error is kept for `check`, and what comes after it is dropped."""

    def __init__(self, file: OutputFile) -> None:
        self._file = file
        self._position = 0
        self._failed: Exception | None = None

    def write(self, data: Any, /) -> int:
        try:
            if self._failed is None:
                self._file.write(data)
        except (MapfoldError, OSError) as error:
            self._failed = error
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        self._position = offset + (self._position if whence == os.SEEK_CUR else 0)
        if self._failed is None:
            self._position = self._file.seek(offset, whence)
        return self._position

    def check(self) -> None:
        """Raise the error of the first write that failed, if one did."""
        if self._failed is not None:
            raise self._failed
