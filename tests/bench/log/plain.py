"""The bare loops that the log is compared with: no format, no checks, no offsets."""

import os
import time
from pathlib import Path

from mcap.records import Message
from mcap.stream_reader import StreamReader

from eventsrc.log.fsync import GROUP_COMMIT, sync_file

from .payloads import Payloads


def append_plain(path: Path, payloads: Payloads, seconds: float) -> float:
    """Bytes to one file, synced as group commit would: events a second."""
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
