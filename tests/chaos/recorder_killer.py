"""Kills a recorder under load at random moments, again and again, and counts what that cost.

    python -m tests.chaos.recorder_killer [--times N] [--rate N] [--seed N]

A robot's publisher sends through a real router all the while. Kept: keyframes that were
acknowledged by the moment of a kill and stand in the log after it. Lost must be 0, and at the end,
after one recorder that is left in peace, the log must hold every keyframe ever published.
"""

import argparse
import json
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from eventsrc._zenoh import Received, ZenohOptions, open_session
from eventsrc.acks import Ack, ack_key
from eventsrc.log import LogReader, LogWriter
from eventsrc.publisher import EnvelopePublisher
from eventsrc.router import Router
from tests.envelopes import envelope
from tests.fixtures_zenoh import LOOPBACK, MAPFOLD, Program

LONGEST_LIFE_S = 0.6
PATIENCE_S = 60.0
RUN = "run-a"


class Robot:
    """Publishes keyframes 0, 1, 2 … in a thread and notes which of them were acknowledged."""

    def __init__(self, endpoint: str, spool: Path, per_second: float) -> None:
        options = ZenohOptions(connect=(endpoint,))
        self.publisher = EnvelopePublisher(options, spool, resend_after_s=0.5)
        self.published = 0
        self._acked: set[int] = set()
        self._lock = threading.Lock()
        self._pause_s = 1 / per_second
        self._stop = threading.Event()
        self._watcher = open_session(options, mode="client")
        self._watcher.subscribe(ack_key(RUN), self._hear)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        while not self._stop.wait(self._pause_s):
            self.publisher.publish(envelope(self.published, run_id=RUN, note="x" * 4_000))
            self.published += 1

    def _hear(self, message: Received) -> None:
        with self._lock:
            for first, last in Ack.decode(message.payload).stretches:
                self._acked.update(range(first, last + 1))

    def acknowledged(self) -> set[int]:
        with self._lock:
            return set(self._acked)

    def finish(self) -> bool:
        """Stop publishing; whether everything was acknowledged in time."""
        self._stop.set()
        self._thread.join()
        return self.publisher.flush(PATIENCE_S)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.publisher.close()
        self._watcher.close()


def stored(log: Path) -> Counter[int]:
    """How often each keyframe stands in the log."""
    with LogReader(log) as reader:
        return Counter(
            json.loads(event.payload)["keyframe_id"]
            for event in reader.read(keys={"tb/detections"})
        )


def kills(log: Path, endpoint: str, robot: Robot, times: int, rng: random.Random) -> Iterator[str]:
    """Start and kill ``times`` recorders. Raises AssertionError when a promise was broken."""
    for number in range(1, times + 1):
        recorder = Program(MAPFOLD, ["record", str(log), "--connect", endpoint])
        if rng.random() < 0.8:
            recorder.wait_for("recording")
        time.sleep(rng.uniform(0.0, LONGEST_LIFE_S))
        recorder.end(signal.SIGKILL)
        promised = robot.acknowledged()
        recorder.close()
        if not log.exists():
            continue
        with LogWriter(log):
            pass  # recovers
        lost = promised - stored(log).keys()
        assert not lost, f"kill {number}: {len(lost)} acknowledged keyframes lost: {sorted(lost)}"
        yield f"kill {number}: kept {len(promised)} acknowledged keyframes, lost 0"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--rate", type=float, default=500.0, help="keyframes a second")
    parser.add_argument("--seed", type=int, default=None)
    arguments = parser.parse_args()
    seed = arguments.seed if arguments.seed is not None else random.randrange(10**6)
    print(f"seed {seed}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (endpoint,) = stack.enter_context(Router(LOOPBACK)).endpoints
        robot = Robot(endpoint, folder / "spool", arguments.rate)
        stack.callback(robot.close)
        log = folder / "log"
        for line in kills(log, endpoint, robot, arguments.times, random.Random(seed)):
            print(line, flush=True)
        last = Program(MAPFOLD, ["record", str(log), "--connect", endpoint])
        stack.callback(last.close)
        everything = robot.finish()
        last.end(signal.SIGINT)
        counts = stored(log)
        missing = set(range(robot.published)) - counts.keys()
        twice = counts.total() - len(counts)
        print(
            f"published {robot.published}, in the log {len(counts)} ({twice} stand there again, "
            f"resent), missing {len(missing)}"
        )
        sys.exit(0 if everything and not missing else 1)


if __name__ == "__main__":
    main()
