"""A process that writes a log as fast as it can and says what is synced, until it is killed.

    python -m tests.chaos.log_writer LOG FSYNC

Prints ``next N`` once, then the durable offset after each commit, one a line. Event i always has
the same payload, so whoever reads the log can tell what should stand there. Every other writer, by
chance, has its segments sealed by a process.
"""

import random
import sys
from pathlib import Path

from eventsrc.log import LogWriter, parse_fsync

KEY = "tb/detections"
ROTATE_EVENTS = 2000


def payload_at(offset: int) -> bytes:
    """Between 8 bytes and 9 kB, by offset."""
    rng = random.Random(offset)
    return b"%08d" % offset + rng.randbytes(rng.choice((0, 10, 1000, 9000)))


def main(log: Path, fsync: str) -> None:
    """Write until killed."""
    by_process = random.random() < 0.5
    with LogWriter(
        log, fsync=parse_fsync(fsync), rotate_events=ROTATE_EVENTS, sealing_process=by_process
    ) as writer:
        print("next", writer.next_offset, flush=True)
        said = writer.durable_offset
        while True:
            writer.append(KEY, payload_at(writer.next_offset))
            if writer.durable_offset > said:
                said = writer.durable_offset
                print(said, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
