"""Speed of time travel on a long log; see docs/time-travel.md for the numbers.

Makes a log of a robot that drives about a house for a long time, unless --log names one that an
earlier run kept, and times the library calls behind the commands. Every ratio is against one plain
fold of the same log (reading, validating, folding, applying to a view) in the same run.
"""

import argparse
import base64
import gc
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from eventsrc.log import LogReader, LogWriter, parse_fsync
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.whatif import what_if
from projections.map.fold import fold_log

ROOMS = [(4.0 * column, 3.5 * row) for row in range(4) for column in range(5)]
CLASSES = ["chair", "cup", "lamp", "desk", "picture", "tv", "couch", "plant"]
RULES = Settings(eps_m=0.75, min_samples=8)
T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Seconds, and the result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def payloads(keyframes: int, detections: int, dim: int) -> Iterator[tuple[int, bytes]]:
    """(stamp_ns, envelope) of a seeded drive: from room to room, about in each, along doors."""
    chance = random.Random(1)
    vectors = np.random.default_rng(1).normal(size=(len(ROOMS) * 8, dim)).astype("<f4")
    encoded = [base64.b64encode(vector.tobytes()).decode() for vector in vectors]
    room, x, y = 0, 0.0, 0.0
    for number in range(keyframes):
        if chance.random() < 0.02:
            room = chance.choice(
                [r for r in (room - 1, room + 1, room + 5, room - 5) if 0 <= r < 20]
            )
        goal = ROOMS[room]
        x += 0.3 * (goal[0] - x) + chance.gauss(0.0, 0.25)
        y += 0.3 * (goal[1] - y) + chance.gauss(0.0, 0.25)
        seen = [8 * room + chance.randrange(8) for _ in range(detections)]
        document = {
            "run_id": f"run-{number // 10_000}",
            "keyframe_id": number % 10_000,
            "timestamp": 1774357200.0 + number,
            "map_x": x,
            "map_y": y,
            "map_yaw": 0.0,
            "detections": [
                {
                    "det_id": f"kf{number}-{index}",
                    "class": CLASSES[thing % 8],
                    "confidence": 0.9,
                    "bbox": [1.0, 2.0, 3.0, 4.0],
                    "embedding": encoded[thing],
                    "embedding_dim": dim,
                    "embedding_model": "bench",
                }
                for index, thing in enumerate(seen)
            ],
        }
        yield 10**9 * (1774357200 + number), json.dumps(document).encode()


def make_log(path: Path, keyframes: int, detections: int, dim: int) -> None:
    with LogWriter(path, fsync=parse_fsync("never")) as writer:
        for stamp_ns, payload in payloads(keyframes, detections, dim):
            writer.append("tb/detections", payload, stamp_ns=stamp_ns)


def plain_fold(log: Path) -> None:
    """One fold as `mapfold state --no-cache` does it."""
    with LogReader(log) as reader:
        fold_log(reader, RULES, keep_embeddings=False)


def say(what: str, value: str) -> None:
    sys.stdout.write(f"{what:<52}{value}\n")
    sys.stdout.flush()


def bench(log: Path, asks: int) -> None:
    used = cpu_seconds()
    one_fold, _ = timed(lambda: plain_fold(log))
    fold_cpu = cpu_seconds() - used
    say("one plain fold", f"{one_fold:.2f} s, {fold_cpu:.2f} s of CPU")
    with LogTimeline(log, RULES) as timeline:
        say("events", f"{timeline.end:,}")
        bench_timeline(timeline, one_fold, asks)
    bench_whatif(log, one_fold, fold_cpu)


def bench_timeline(timeline: LogTimeline, one_fold: float, asks: int) -> None:
    first, _ = timed(lambda: timeline.at(timeline.end))
    say("first at(end) of a process", f"{first:.2f} s")
    folding, history = timed(lambda: timeline.history)
    say("folding the history, once per process", f"{folding:.2f} s, {folding / one_fold:.2f} folds")
    bench_at(timeline, asks, "at(random offset)")
    gc.freeze()
    bench_at(timeline, asks, "the same after gc.freeze()")
    gc.unfreeze()
    seconds, merges = timed(timeline.merges)
    say(f"merges ({len(merges)})", f"{1e3 * seconds:.1f} ms")
    for life in (history.places[0], history.places[-1]):
        seconds, _ = timed(lambda life=life: timeline.why(life.place_id))
        say(f"why {life.place_id}", f"{1e3 * seconds:.0f} ms")
    timeline.facts()
    for expression, scan in (
        ("keyframe_count > 77777", False),
        ("place_count < 3", False),
        ("place_count < 3", True),
    ):
        seconds, found = timed(lambda e=expression, s=scan: timeline.bisect(e, scan=s))
        how = "--scan" if scan else ""
        say(
            f"bisect {expression!r} {how}",
            f"{1e3 * seconds:.0f} ms, {found.evaluations:,} maps asked",
        )
    seconds, _ = timed(lambda: timeline.diff(timeline.end // 2, timeline.end))
    say("diff of the middle and the end", f"{seconds:.2f} s")


def bench_at(timeline: LogTimeline, asks: int, what: str) -> None:
    chance = random.Random(2)
    walls, cpus = [], []
    for _ in range(asks):
        offset, used = chance.randrange(timeline.end), time.process_time()
        walls.append(1e3 * timed(lambda offset=offset: timeline.at(offset))[0])
        cpus.append(1e3 * (time.process_time() - used))
    for spent, clock in ((sorted(walls), "wall"), (sorted(cpus), "CPU")):
        p50, p95 = statistics.median(spent), spent[int(0.95 * asks)]
        say(f"{what}, {asks} asked, {clock}", f"p50 {p50:.0f} ms, p95 {p95:.0f} ms")


def bench_whatif(log: Path, one_fold: float, fold_cpu: float) -> None:
    others = [RULES.with_assignments([f"eps_m={eps}"]) for eps in (0.5, 1.0, 1.5)]
    with LogReader(log) as reader:
        end = reader.next_offset
    used = cpu_seconds()
    seconds, found = timed(lambda: what_if(log, RULES, others, end, processes=2))
    used = cpu_seconds() - used
    say(
        f"whatif of {len(found.all)} settings in 2 processes",
        f"{seconds:.2f} s, {seconds / one_fold:.2f} folds",
    )
    say("its CPU over two cores, by a fold's CPU", f"{used / 2 / fold_cpu:.2f} folds")


def cpu_seconds() -> float:
    """CPU time of this process and its ended children: what a busy machine does not blur."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=100_000)
    parser.add_argument("--detections", type=int, default=3)
    parser.add_argument("--dim", type=int, default=512)
    parser.add_argument("--asks", type=int, default=40)
    parser.add_argument("--log", type=Path, help="keep the log here, and use it if it is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = options.log or Path(folder) / "log"
        if not log.exists():
            make_log(log, options.keyframes, options.detections, options.dim)
        bench(log, options.asks)


if __name__ == "__main__":
    main()
