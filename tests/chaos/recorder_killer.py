"""Kills a recorder under load at random moments, again and again, and counts what that cost.

    python -m tests.chaos.recorder_killer [--times N] [--rate N] [--seed N]

A robot's publisher sends through a real router all the while, and the recorder is `mapfold record`
in a process of its own. Kept: keyframes that were acknowledged by the moment of a kill and stand in
the log after it. Lost must be 0. At the end, after one recorder that is left in peace, the log must
hold every keyframe ever published, and the fold each of them once, though some stand in the log
again: what was on its way at a kill is sent again.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from eventsrc.log import LogReader, LogWriter
from eventsrc.robot.acks import Ack, ack_key, payload_sha256
from eventsrc.robot.publisher import EnvelopePublisher
from eventsrc.transport.session import Received, Router, ZenohOptions, open_session
from projections.model.fold import fold_log
from projections.settings import Settings
from tests.envelopes import envelope, payload
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
        self._keyframes: dict[str, int] = {}
        self._lock = threading.Lock()
        self._pause_s = 1 / per_second
        self._stop = threading.Event()
        self._watcher = open_session(options, mode="client")
        self._watcher.subscribe(ack_key(RUN), self._hear)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        while not self._stop.wait(self._pause_s):
            message = payload(envelope(self.published, run_id=RUN, note="x" * 4_000))
            with self._lock:
                self._keyframes[payload_sha256(message)] = self.published
            self.publisher.publish(message)
            self.published += 1

    def _hear(self, message: Received) -> None:
        with self._lock:
            acked = Ack.decode(message.payload).sha256
            self._acked.update(self._keyframes[digest] for digest in acked)

    def acknowledged(self) -> set[int]:
        """What was acknowledged by now."""
        with self._lock:
            return set(self._acked)

    def finish(self) -> bool:
        """Stop publishing; whether everything was acknowledged in time."""
        self._stop.set()
        self._thread.join()
        return self.publisher.flush(PATIENCE_S)

    def close(self) -> None:
        """Stop for good."""
        self._stop.set()
        self._thread.join()
        self.publisher.close()
        self._watcher.close()


class Stored:
    """How often each keyframe stands in the log; reads on from where it was."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._next_offset = 0
        self.counts: Counter[int] = Counter()

    def read_on(self) -> None:
        """Look at what was added."""
        with LogReader(self._log) as reader:
            for event in reader.read(self._next_offset, keys={"tb/detections"}):
                self.counts[json.loads(event.payload)["keyframe_id"]] += 1
            self._next_offset = reader.next_offset


@dataclass(frozen=True)
class Life:
    """One recorder's: ``promised`` keyframes were acknowledged by all so far when it was killed,
    and ``lost`` of them are not in the log after that."""

    promised: int
    lost: int


@dataclass(frozen=True)
class End:
    """What came of it all. ``again`` is how often a keyframe stands in the log once more."""

    published: int
    acknowledged: bool
    missing: int
    again: int
    folded: int

    @property
    def good(self) -> bool:
        """Every keyframe is acknowledged, in the log, and once in the map."""
        return self.acknowledged and not self.missing and self.folded == self.published


class Ordeal:
    """A router, a robot, and one recorder after the other; a context manager."""

    def __init__(self, folder: Path, rate: float, rng: random.Random) -> None:
        self._log = folder / "log"
        self._rng = rng
        with ExitStack() as stack:
            (self._endpoint,) = stack.enter_context(Router(LOOPBACK)).endpoints
            self._robot = Robot(self._endpoint, folder / "spool", rate)
            stack.callback(self._robot.close)
            self._stack = stack.pop_all()

    def lives(self, times: int) -> Iterator[Life]:
        """Start and kill ``times`` recorders. Half of the logs are recovered here, the others are
        found by the next recorder as they were left, and it may be killed while it recovers."""
        stored = Stored(self._log)
        for _ in range(times):
            promised = self._one_life()
            if not any(self._log.glob("*.mcap*")):  # killed before there was a log
                assert not promised
                continue
            if self._rng.random() < 0.5:
                LogWriter(self._log).close()
            stored.read_on()
            yield Life(len(promised), len(promised - stored.counts.keys()))

    def _one_life(self) -> set[int]:
        """What was acknowledged when the recorder had been killed."""
        recorder = Program(MAPFOLD, ["record", str(self._log), "--connect", self._endpoint])
        if self._rng.random() < 0.8:
            recorder.wait_for("recording")
        try:
            recorder.process.wait(self._rng.uniform(0.0, LONGEST_LIFE_S))
        except subprocess.TimeoutExpired:
            assert recorder.end(signal.SIGKILL) == -signal.SIGKILL
        else:
            raise AssertionError(f"the recorder ended by itself: {recorder.lines}")
        finally:
            recorder.close()
        return self._robot.acknowledged()

    def end(self) -> End:
        """Leave one recorder in peace until it has everything."""
        last = Program(MAPFOLD, ["record", str(self._log), "--connect", self._endpoint])
        self._stack.callback(last.close)
        acknowledged = self._robot.finish()
        assert last.end(signal.SIGINT) in (0, 3), last.lines
        stored = Stored(self._log)
        stored.read_on()
        published = self._robot.published
        with LogReader(self._log) as reader:
            _, view = fold_log(reader, Settings())
        return End(
            published=published,
            acknowledged=acknowledged,
            missing=len(set(range(published)) - stored.counts.keys()),
            again=stored.counts.total() - len(stored.counts),
            folded=len(view.keyframes),
        )

    def __enter__(self) -> "Ordeal":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def main() -> int:
    """0 when nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--rate", type=float, default=500.0, help="keyframes a second")
    parser.add_argument("--seed", type=int, default=random.randrange(10**6))
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    lost = 0
    with (
        tempfile.TemporaryDirectory() as folder,
        Ordeal(Path(folder), args.rate, random.Random(args.seed)) as ordeal,
    ):
        for number, life in enumerate(ordeal.lives(args.times), 1):
            print(f"life {number}: kept {life.promised - life.lost}, lost {life.lost}", flush=True)
            lost += life.lost
        end = ordeal.end()
    print(
        f"published {end.published}, missing {end.missing}, in the map {end.folded}; "
        f"{end.again} stand in the log again, resent; lost {lost} acknowledged ones"
    )
    return 0 if end.good and not lost else 1


if __name__ == "__main__":
    sys.exit(main())
