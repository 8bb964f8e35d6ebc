"""The floor: bare loops without format, checks or offsets."""

import os
import time
from pathlib import Path
from typing import Self

from mcap.records import Message
from mcap.stream_reader import StreamReader

from eventsrc.log.durable_files import GROUP_COMMIT, sync_file

from .payloads import Payloads


class PlainFile:
    """A file that is synced as often as group commit does."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        self._begun = self._synced = self._last = 0.0
        self._waiting = 0
        self.count = 0

    def append(self, data: bytes) -> None:
        """Write, and sync when due."""
        os.write(self._fd, data)
        self.count += 1
        self._waiting += 1
        self._last = time.perf_counter()
        self._begun = self._begun or self._last
        if (
            self._waiting == GROUP_COMMIT.max_events
            or self._last - self._synced > GROUP_COMMIT.interval_ns / 1e9
        ):
            sync_file(self._fd)
            self._synced, self._waiting = time.perf_counter(), 0

    @property
    def per_s(self) -> float:
        """Events a second, from the first to the last."""
        return (self.count - 1) / (self._last - self._begun)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        sync_file(self._fd)
        os.close(self._fd)


def append_plain(path: Path, payloads: Payloads, seconds: float) -> float:
    """A bare loop that syncs as often as group commit does: events a second."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    start = synced = time.perf_counter()
    count = waiting = 0
    while (now := time.perf_counter()) - start < seconds:
        os.write(fd, payloads[count])
        count += 1
        waiting += 1
        if waiting == GROUP_COMMIT.max_events or now - synced > GROUP_COMMIT.interval_ns / 1e9:
            sync_file(fd)
            synced, waiting = time.perf_counter(), 0
    sync_file(fd)
    os.close(fd)
    return count / (time.perf_counter() - start)


def read_mcap(log: Path) -> float:
    """All segments through the mcap package's stream reader: messages a second."""
    start = time.perf_counter()
    count = 0
    for path in sorted(log.glob("*.mcap")):
        with path.open("rb") as file:
            for record in StreamReader(file).records:
                count += isinstance(record, Message)
    return count / (time.perf_counter() - start)
