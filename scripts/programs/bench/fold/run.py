"""The fold's cost as ratios within one run, so that they hold on any machine."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import msgspec

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.log import LogReader, LogWriter
from projections.fold.core_index import CoreIndex
from projections.fold.exact import unit_vectors
from projections.fold.place_members import PosedKeyframe
from projections.fold.places import Places
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import fold_events, fold_log
from projections.map.parsing import READ_AHEAD
from projections.map.view import MapView
from scripts.programs.bench.fold.plain import fold_plain
from scripts.programs.bench.fold.streams import (
    DIM,
    MODEL,
    house_walk,
    keyframes,
    pictures,
    random_walk,
)

QUICK = "--quick" in sys.argv
EPS_UM, LEAST = 1_500_000, 3
clock = time.process_time  # other work on the machine is not ours


def report(name: str, value: float, limit: float, unit: str = "") -> None:
    verdict = "ok" if value <= limit else "TOO MUCH"
    print(f"{name:<66} {value:>9.2f}{unit}  (at most {limit:g}{unit})  {verdict}", flush=True)


def fold_places(points: list[tuple[int, int]]) -> tuple[float, list[int | None]]:
    places = Places(CoreIndex(EPS_UM, LEAST))
    start = clock()
    for n, (x, y) in enumerate(points):
        places.fold(PosedKeyframe(n, n, 0, "r", x, y))
    return clock() - start, [places.label(n) for n in range(len(points))]


def same_noise(ours: list[int | None], theirs: list[int]) -> bool:
    return [label is None for label in ours] == [label < 0 for label in theirs]


def plain() -> None:
    points = random_walk(4_000 if QUICK else 16_000)
    seconds, ours = fold_places(points)
    start = clock()
    theirs = fold_plain(points, EPS_UM, LEAST)
    slow = clock() - start
    if not same_noise(ours, theirs):
        raise SystemExit("the plain version disagrees about noise")
    print(f"{len(points)} poses: ours {seconds:.2f} s, plain {slow:.1f} s")
    report("time / time of plain O(n²), × 40", seconds / slow * 40, 1)


def peer() -> None:
    points = random_walk(2_000 if QUICK else 16_000)
    seconds, ours = fold_places(points)
    job = {"points": points, "eps": EPS_UM, "min_samples": LEAST}
    done = subprocess.run(
        [".venv/bench-peer/bin/python", "scripts/programs/bench/fold/peer.py"],
        input=json.dumps(job),
        capture_output=True,
        text=True,
        check=True,
    )
    theirs = json.loads(done.stdout)
    if not same_noise(ours, theirs["labels"]):
        raise SystemExit("incdbscan disagrees about noise")
    print(f"{len(points)} poses: ours {seconds:.2f} s, incdbscan {theirs['seconds']:.1f} s")
    report("time / time of incdbscan, × 20", seconds / theirs["seconds"] * 20, 1)


def lifelong() -> None:
    count = 100_000 if QUICK else 1_000_000
    places = Places(CoreIndex(EPS_UM, LEAST))
    before, number = _resident(), 0

    def fold_one(at: tuple[float, float]) -> None:
        nonlocal number
        places.fold(PosedKeyframe(number, number, 0, "r", round(at[0] * 1e6), round(at[1] * 1e6)))
        number += 1

    _tenths("places alone", house_walk(count), count, fold_one)
    report("  memory per keyframe", (_resident() - before) / count, 300, " B")
    semantic_map = SemanticMap(Settings())
    _tenths(
        "whole fold without detections",
        keyframes(count, 0),
        count,
        lambda accepted: semantic_map.fold(semantic_map.next_offset, accepted),
    )


def rooms() -> None:
    count = 100_000 if QUICK else 1_000_000
    page, by_rooms = SemanticMap(Settings()), SemanticMap(Settings(places="rooms"))
    before = _resident()
    took = [
        _tenths(
            name,
            keyframes(count, 0),
            count,
            lambda accepted, of=of: of.fold(of.next_offset, accepted),
        )
        for name, of in (("places=page, no detections", page), ("by rooms", by_rooms))
    ]
    print(f"memory of the two: {(_resident() - before) / 1e6:.0f} MB")
    report("fold by rooms / fold with places=page", took[1] / took[0], 1.5)


def _tenths(name: str, stream, count: int, fold_one: Callable) -> float:
    """Report the last tenth against the second; the seconds of all."""
    tenths = []
    for _ in range(10):
        seconds = 0.0
        for _ in range(10):  # the stream's own making is not timed
            chunk = list(islice(stream, count // 100))
            start = clock()
            for item in chunk:
                fold_one(item)
            seconds += clock() - start
        tenths.append(seconds / count * 10e6)
    print(f"{count} keyframes in one house, {name}: {tenths[1]:.1f} µs, last {tenths[9]:.1f} µs")
    report("  last tenth / second tenth", tenths[9] / tenths[1], 1.5)
    return sum(tenths) * count / 10e6


def growth() -> None:
    small, large = (2_000, 20_000) if QUICK else (10_000, 100_000)
    few = _fold_time(small)
    before = _resident()
    many = _fold_time(large)
    memory = (_resident() - before) / 1e6
    print(f"three detections a keyframe: {few / small * 1e6:.0f} and {many / large * 1e6:.0f} µs")
    report(f"time({large}) / time({small})", many / few, 12)
    print(f"memory of the fold and its view after {large} keyframes: {memory:.0f} MB")


def evidence() -> None:
    small, large = (1_600, 16_000) if QUICK else (10_000, 100_000)
    by_page = _Fold(Settings())
    before = _resident()
    by_evidence = _Fold(Settings(fusion="evidence"))
    few = 0.0
    with gc_paused():
        for chunk in _chunks(pictures(large)):
            by_evidence.fold(chunk)
            if by_page.folded + len(chunk) <= small:  # in turn: the machine is the same for both
                by_page.fold(chunk)
                few = by_evidence.seconds
    memory = (_resident() - before) / 1e6
    each = by_page.seconds / by_page.folded * 1e6, by_evidence.seconds / large * 1e6
    print(f"pictures of a camera: with fusion=page {each[0]:.0f} µs, by evidence {each[1]:.0f} µs")
    report("fold by evidence / fold with fusion=page", few / by_page.seconds, 2.5)
    report(f"by evidence: time({large}) / time({small})", by_evidence.seconds / few, 12)
    print(f"memory of the fold by evidence and its view: {memory:.0f} MB")


def _fold_time(count: int) -> float:
    fold = _Fold(Settings())
    with gc_paused():
        for chunk in _chunks(keyframes(count, 3)):
            fold.fold(chunk)
    global kept
    kept = fold  # measured while it is there
    return fold.seconds


class _Fold:
    """A map and its view, and the processor time that folding keyframes into them has taken."""

    def __init__(self, settings: Settings) -> None:
        self._map = SemanticMap(settings)
        self._view = MapView(settings, keep_embeddings=False)
        self.seconds, self.folded = 0.0, 0

    def fold(self, chunk: list[Accepted]) -> None:
        start = clock()
        units = iter(unit_vectors([v for accepted in chunk for v in accepted.vectors]))
        for accepted in chunk:
            offset = self._map.next_offset
            own = list(islice(units, len(accepted.vectors)))
            self._view.apply_event(offset, self._map.fold(offset, accepted, own))
        self.seconds += clock() - start
        self.folded += len(chunk)


def _chunks(stream: Iterator[Accepted]) -> Iterator[list[Accepted]]:
    while chunk := list(islice(stream, READ_AHEAD)):
        yield chunk


def whole() -> None:
    count = 2_000 if QUICK else 8_000
    with tempfile.TemporaryDirectory() as folder:
        with LogWriter(Path(folder) / "log") as writer:
            for accepted in keyframes(count, 3):
                writer.append("tb/detections", _payload(accepted))
        with LogReader(Path(folder) / "log") as reader:
            rounds = [_whole_once(reader) for _ in range(7)]
    names = ("read", "read + json.loads", "read + validate", "fold", "fold and view")
    best = [min(column) / count * 1e6 for column in zip(*rounds, strict=True)]
    print(", ".join(f"{name} {value:.0f} µs" for name, value in zip(names, best, strict=True)))
    report("whole fold / (read + json.loads)", best[3] / best[1], 4)
    print(f"  and with a view built from the deltas: {best[4] / best[1]:.2f}")


def _whole_once(reader: LogReader) -> list[float]:
    def timed(work: Callable[[], object]) -> float:
        start = clock()
        work()
        return clock() - start

    def fold_all() -> None:
        with gc_paused():
            for _ in fold_events(reader.read(), SemanticMap(Settings()), ahead=READ_AHEAD):
                pass

    return [
        timed(lambda: [None for _ in reader.read()]),
        timed(lambda: [json.loads(event.payload) and None for event in reader.read()]),
        timed(lambda: [ingest(event.payload) and None for event in reader.read()]),
        timed(fold_all),
        timed(lambda: fold_log(reader, Settings(), keep_embeddings=False)),
    ]


def _payload(accepted: Accepted) -> bytes:
    import base64

    document = msgspec.to_builtins(accepted.envelope)
    for detection, det_id, vector in zip(
        document["detections"], accepted.det_ids, accepted.vectors, strict=True
    ):
        raw = base64.b64encode(vector.tobytes()).decode()
        detection |= {
            "det_id": det_id,
            "embedding": raw,
            "embedding_dim": DIM,
            "embedding_model": MODEL,
        }
    return json.dumps(document).encode()


def _resident() -> int:
    """Bytes of memory in use now, on Linux; else the most so far."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


BENCHMARKS = {f.__name__: f for f in (plain, peer, lifelong, rooms, growth, evidence, whole)}

if __name__ == "__main__":
    wanted = [name for name in sys.argv[1:] if not name.startswith("--")]
    for name in wanted or BENCHMARKS:
        BENCHMARKS[name]()
