"""Processor time of each stage between a recorder's queue and an answer, in microseconds.

    scripts/measure_stages [--keyframes N] [--questions N] [--json]

Processor time and not wall time, because it hardly depends on what else the machine does. ``own``
is that of the Python process, ``server`` that of PostgreSQL. With 17,000 keyframes there are enough
vectors for an HNSW index; with fewer, questions read all of them. `scripts/simulate_fleet` measures
publishing and routing, with real processes.
"""

import argparse
import gc
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import GROUP_COMMIT, Event, LogReader, LogWriter, NewEvent
from eventsrc.record.append import check_payloads
from eventsrc.record.robot.acks import payload_sha256
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.parsing import parse_events
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets, connect
from projections.postgres.embedded import EmbeddedServer
from projections.surfaces.serve import Answerer, Pools
from scripts.programs.bench.projections.world import KEY, World
from tests.support.commands import family_cpu_seconds

TOGETHER = 16
"""Messages that a recorder and a fold check together."""
GROUP = 256
"""Messages of a commit at full speed."""


@dataclass(frozen=True)
class Stage:
    """Processor time, microseconds for each keyframe or question."""

    name: str
    own_us: float
    server_us: float = 0.0


class Meter:
    """Own processor time and that of a database server."""

    def __init__(self, server: EmbeddedServer) -> None:
        self._postmaster = int((server.data / "postmaster.pid").read_text().split()[0])

    @contextmanager
    def stage(self, found: list[Stage], name: str, count: int) -> Iterator[None]:
        """Measure a block and append a stage."""
        gc.collect()
        own, served = time.process_time(), family_cpu_seconds(self._postmaster)
        yield
        own = time.process_time() - own
        served = family_cpu_seconds(self._postmaster) - served
        found.append(Stage(name, 1e6 * own / count, 1e6 * served / count))


def record(folder: Path, keyframes: int, meter: Meter) -> list[Stage]:
    """Check, append, seal."""
    world = World()
    payloads = [world.payload(number) for number in range(keyframes)]
    found: list[Stage] = []
    with meter.stage(found, "check", keyframes):
        for start in range(0, keyframes, TOGETHER):
            some = [(KEY, payload) for payload in payloads[start : start + TOGETHER]]
            check_payloads(some, first=FIRST_OFFSET, logged_ns=0, max_bytes=2**24)
    with meter.stage(found, "SHA-256", keyframes):
        for payload in payloads:
            payload_sha256(payload)
    writer = LogWriter(folder / "log", fsync=GROUP_COMMIT, rotate_bytes=2**40)
    with meter.stage(found, "append and fsync", keyframes):
        for start in range(0, keyframes, GROUP):
            now = writer.now_ns()
            writer.append_all([NewEvent(KEY, p, now, now) for p in payloads[start : start + GROUP]])
        writer.sync()
    with meter.stage(found, "seal", keyframes):
        writer.close()
    return found


def project(
    folder: Path, keyframes: int, meter: Meter, targets: Targets
) -> tuple[list[Stage], dict[str, float]]:
    """Read, parse, fold, then everything that a rebuild and a tail do; and bytes for each keyframe
    in the log and in the database."""
    log = folder / "log"
    found: list[Stage] = []
    events: list[Event] = []
    with LogReader(log) as reader:
        with meter.stage(found, "read", keyframes):
            events = list(reader.read())
        with meter.stage(found, "parse", keyframes):
            for start in range(0, keyframes, TOGETHER):
                parse_events(events[start : start + TOGETHER])
        events.clear()
        with meter.stage(found, "read, parse and fold", keyframes):
            fold_log(reader, Settings(), keep_embeddings=False)
    whole = found.pop()
    found.append(Stage("fold", whole.own_us - sum(stage.own_us for stage in found)))
    with meter.stage(found, "rebuild without HNSW", keyframes):
        rebuild(log, targets, Settings(), hnsw=False, workers=0)
    whole = found.pop()
    made = whole.own_us - sum(stage.own_us for stage in found)
    found.append(Stage("rows and COPY", made, whole.server_us))
    with meter.stage(found, "rebuild, 2 more processes parse", keyframes):
        rebuild(log, targets, Settings(), hnsw=False, workers=2)
    rebuild(log, targets, Settings(), until=FIRST_OFFSET)
    with meter.stage(found, "tail when behind, all of it", keyframes):
        tail(log, targets, Settings(), once=True)
    with meter.stage(found, "rebuild with HNSW", keyframes):
        rebuild(log, targets, Settings(), workers=0)
    indexed = found.pop()
    found.append(Stage("HNSW index", 0.0, indexed.server_us - whole.server_us))
    with connect(targets.graph_url) as connection:
        row = connection.execute("SELECT pg_database_size(current_database())").fetchone()
    assert row is not None
    sizes = {
        "log, sealed": sum(path.stat().st_size for path in log.glob("*.mcap")),
        "database": int(row[0]),
    }
    return found, {name: size / keyframes for name, size in sizes.items()}


def ask(meter: Meter, targets: Targets, questions: int) -> list[Stage]:
    """Re-localisation and state, one question at a time, through what `mapfold serve` calls."""
    world, found = World(11), list[Stage]()
    bodies = [
        json.dumps(json.loads(world.payload(number))["detections"]).encode()
        for number in range(questions)
    ]
    with Pools(targets, 1) as pools:
        answerer = Answerer(pools, per_second=1e6)
        answerer.relocalize(bodies[0], {})
        with meter.stage(found, "re-localisation", questions):
            for body in bodies:
                answerer.relocalize(body, {})
        with meter.stage(found, "places near a pose", questions):
            for number in range(questions):
                answerer.state("places", {"x": str(number % 20), "y": "0", "radius": "5"})
    return found


def measure(folder: Path, keyframes: int, questions: int) -> tuple[list[Stage], dict[str, float]]:
    """All stages, in their order, and the bytes of `project`."""
    with EmbeddedServer(folder / "home") as server:
        meter, targets = Meter(server), Targets(server.url, server.url)
        recorded = record(folder, keyframes, meter)
        projected, sizes = project(folder, keyframes, meter, targets)
        return [*recorded, *projected, *ask(meter, targets, questions)], sizes


def main() -> None:
    """Print a table, or one JSON document."""
    about = __doc__.splitlines()[0] if __doc__ else None
    parser = argparse.ArgumentParser(prog="scripts/measure_stages", description=about)
    parser.add_argument("--keyframes", type=int, default=17_000, help="default 17,000")
    parser.add_argument("--questions", type=int, default=200, help="default 200")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    args = parser.parse_args()
    if min(args.keyframes, args.questions) < 1:
        parser.error("at least one keyframe and one question")
    folder = Path(tempfile.mkdtemp(prefix="mapfold-stages-"))
    os.environ["MAPFOLD_HOME"] = str(folder / "home")
    try:
        stages, sizes = measure(folder, args.keyframes, args.questions)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    if args.json:
        each = {s.name: {"own_us": s.own_us, "server_us": s.server_us} for s in stages}
        print(
            json.dumps(
                {
                    "keyframes": args.keyframes,
                    "questions": args.questions,
                    "us": each,
                    "bytes": sizes,
                }
            )
        )
        return
    print(
        f"{args.keyframes:,} keyframes of 9 kB, {args.questions:,} questions; load "
        f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, Python {sys.version.split()[0]}"
    )
    print(f"{'processor µs for each':<30} {'own':>10} {'server':>10}")
    for stage in stages:
        print(f"{stage.name:<30} {stage.own_us:>10,.1f} {stage.server_us:>10,.1f}")
    for name, size in sizes.items():
        print(f"bytes a keyframe, {name:<12} {size:>10,.0f}")


if __name__ == "__main__":
    main()
