"""Kills a log's writer at random moments, again and again, and counts what that cost.

    scripts/chaos_log [--times N] [--seconds S] [--fsync 50ms] [--seed N] [LOG]

Kept: events that were acknowledged before the kill and stand in the log after it. Lost must be 0.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from eventsrc.log import LogReader, LogWriter, verify_log
from scripts.programs.chaos.log_writer import event_at
from tests.support.logs import recorded

ROOT = Path(__file__).parents[3]
LONGEST_LIFE_S = 0.9


@dataclass(frozen=True)
class Life:
    """One writer's life: ``acknowledged`` is the last durable offset it told, ``kept`` how many
    events the log had after it was killed and recovered."""

    acknowledged: int
    kept: int

    @property
    def lost(self) -> int:
        """Acknowledged and not there."""
        return max(0, self.acknowledged - self.kept)


def lives(
    log: Path,
    times: int,
    fsync: str,
    rng: random.Random,
    *,
    mixed: bool = False,
    longest_s: float = LONGEST_LIFE_S,
) -> Iterator[Life]:
    """Start and kill ``times`` times, within ``longest_s`` each, and recover after about half.

    Raises AssertionError when the log holds anything but a prefix of what was written.
    """
    checked = acknowledged = 0
    for _ in range(times):
        acknowledged = max(acknowledged, _one_life(log, fsync, rng, mixed, longest_s))
        if rng.random() < 0.5:
            continue  # the next writer finds what this one left, and may be killed recovering it
        with LogWriter(log) as writer:
            kept = writer.next_offset
        checked = _check(log, checked, kept, mixed)
        yield Life(acknowledged, kept)


def _one_life(log: Path, fsync: str, rng: random.Random, mixed: bool, longest_s: float) -> int:
    """The last offset a writer acknowledged before it was killed."""
    command = [sys.executable, "-m", "scripts.programs.chaos.log_writer", str(log), fsync]
    command += ["mixed"] * mixed
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if rng.random() < 0.7:
            process.stdout.readline()  # it holds the lock and writes from here on
        try:
            process.wait(rng.uniform(0.0, longest_s))
        except subprocess.TimeoutExpired:
            process.kill()
        told = [line.split() for line in process.stdout if line.endswith("\n")]
    return max((int(words[-1]) for words in told if len(words) == 1), default=0)


def _check(log: Path, start: int, end: int, mixed: bool) -> int:
    with LogReader(log) as reader:
        assert reader.next_offset == end
        expected = start
        for event in reader.read(start):
            assert event.offset == expected
            written = recorded(event_at(event.offset, mixed=mixed), event.offset)
            assert event == written, f"offset {event.offset} is not itself"
            expected += 1
    assert expected == end
    return end


def main() -> int:
    """0 when nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("log", nargs="?", type=Path, help="a new folder; default: a temporary one")
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--seconds", type=float, help="go on for so long instead of --times")
    parser.add_argument("--fsync", default="50ms")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        return _run(args.log or Path(folder) / "log", args)


def _run(log: Path, args: argparse.Namespace) -> int:
    lost = kept = 0
    times = args.times if args.seconds is None else 10**9
    end = time.monotonic() + (args.seconds or float("inf"))
    for life in lives(log, times, args.fsync, random.Random(args.seed)):
        lost += life.lost
        kept = life.kept
        print(f"acknowledged {life.acknowledged}, kept {kept}, lost {life.lost}")
        if time.monotonic() > end:
            break
    damage = [f for f in verify_log(log).findings if f.kind not in ("schema", "time")]
    print(f"kept {kept} events, lost {lost} acknowledged ones, {len(damage)} findings of damage")
    return 1 if lost or damage else 0


if __name__ == "__main__":
    sys.exit(main())
