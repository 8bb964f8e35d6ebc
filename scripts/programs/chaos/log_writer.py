"""A process that writes a log as fast as it can and says what is synced, until it is killed.

    python -m scripts.programs.chaos.log_writer LOG FSYNC [mixed]

Prints ``next N`` once, then the durable offset after each commit, one a line. Event i always has
the same payload, so a reader of the log can tell what should stand there; if ``mixed``, messages
of ROS, pictures and envelopes stand side by side (`verbatim`). Every other writer, by chance,
has its segments sealed by a process.
"""

import random
import sys
from pathlib import Path

from eventsrc.log import LogWriter, NewEvent, parse_fsync
from tests.support.logs import mixed_event

KEY = "tb/detections"
ROTATE_EVENTS = 2000


def payload_at(offset: int) -> bytes:
    """Between 8 bytes and 9 kB, by offset."""
    rng = random.Random(offset)
    return b"%08d" % offset + rng.randbytes(rng.choice((0, 10, 1000, 9000)))


def event_at(offset: int, *, mixed: bool) -> NewEvent:
    """What is written at an offset."""
    return mixed_event(offset) if mixed else NewEvent(KEY, payload_at(offset), offset, offset)


def main(log: Path, fsync: str, mixed: bool) -> None:
    """Write until killed."""
    by_process = random.random() < 0.5
    with LogWriter(
        log, fsync=parse_fsync(fsync), rotate_events=ROTATE_EVENTS, sealing_process=by_process
    ) as writer:
        print("next", writer.next_offset, flush=True)
        said = writer.durable_offset
        while True:
            writer.append_all([event_at(writer.next_offset, mixed=mixed)])
            if writer.durable_offset > said:
                said = writer.durable_offset
                print(said, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], "mixed" in sys.argv[3:])
