"""Time travel from the history that is kept beside a log, against one that each process folds into
memory; see docs/time-travel.md for the numbers.

Each case is a process of its own, so that its memory can be told. ``memory`` is the history as
records, without files; ``first`` folds the log and keeps the history; ``later`` finds it kept;
``grown`` finds it kept of a log that has since got more events.
"""

import argparse
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from eventsrc.envelope.model import Offset
from eventsrc.log import LogWriter, parse_fsync
from projections.history import LogTimeline
from projections.history.diff import difference_of
from projections.history.known_history import KnownHistory
from projections.history.merge_reasons import merge_document
from projections.map.digest import map_digest
from projections.map.state_output import state_text
from projections.map.view import MapView
from scripts.programs.bench.timetravel import RULES, make_log, payloads, say, timed
from tests.support.histories import MemoryHistory

MORE = 1_000
"""Events by which a log has grown."""


def case(log: Path, name: str, asks: int) -> None:
    """One process's answers, timed."""
    started = time.process_time()
    with LogTimeline(log, RULES, note=print, cache=name != "memory") as timeline:
        known = timeline.knowing()
        taken, known = timed(lambda: MemoryHistory(known) if name == "memory" else _ready(known))
        spent = time.process_time() - started
        say(f"{name}: history", f"{taken:.2f} s, {spent:.2f} s of CPU, {_memory()}")
        ends = offsets(timeline.end, asks)
        for number, end in enumerate([next(ends), next(ends)], 1):
            wall, cpu = _spent(known, end, shown)
            took = f"{1e3 * wall:.0f} ms, {1e3 * cpu:.0f} ms of CPU"
            say(f"{name}: state number {number}, without digest", took)
        seconds, found = timed(lambda: [merge_document(known.history, m) for m in known.merges()])
        say(f"{name}: merges ({len(found)})", f"{1e3 * seconds:.0f} ms, {_memory()}")
        uses = (("at", _nothing, asks), ("at, every record used", _every_record, asks // 8))
        for what, use, count in uses:
            spents = [_spent(known, end, use) for end in ends_of(ends, count)]
            for clock, values in zip(("wall", "CPU"), zip(*spents, strict=True), strict=True):
                p50, p95 = statistics.median(values), sorted(values)[int(0.95 * count)]
                times = f"p50 {1e3 * p50:.0f} ms, p95 {1e3 * p95:.0f} ms"
                say(f"{name}: {what}, {clock}", f"{times}, {_memory()}")
        place = known.history.places[0].place_id
        say(f"{name}: why {place}", f"{timed(lambda: known.why(place))[0]:.2f} s, {_memory()}")
        # Of other maps in each case: digests are kept.
        last = Offset(timeline.end - len(name))
        middle = Offset(last // 2)
        for what in ("first", "again"):
            started = time.process_time()
            map_digest(known.at(middle))
            spent = time.process_time() - started
            say(f"{name}: digest of the middle, {what}", f"{spent:.2f} s of CPU")
        started = time.process_time()
        difference_of(known.at(middle), known.at(last), {}, ())
        spent = time.process_time() - started
        say(f"{name}: diff of the middle and the end", f"{spent:.2f} s of CPU, {_memory()}")
        search = timed(lambda: known.bisect("noise_count < 5", scan=True))[0]
        say(f"{name}: bisect, asked after every event", f"{search:.2f} s, {_memory()}")


def _ready(known: KnownHistory) -> KnownHistory:
    _ = known.history
    return known


def shown(view: MapView) -> None:
    state_text(view, None)


def _spent(known: KnownHistory, end: Offset, use: Callable[[MapView], None]) -> tuple[float, float]:
    """Seconds by the clock, and of CPU."""
    started = time.process_time()
    return timed(lambda: use(known.at(end)))[0], time.process_time() - started


def _nothing(view: MapView) -> None:
    """The view alone."""


def _every_record(view: MapView) -> None:
    for _ in view.keyframes:
        pass
    for _ in view.observations:
        pass


def offsets(end: int, seed: int) -> Iterator[Offset]:
    chance = random.Random(seed)
    while True:
        yield Offset(chance.randrange(end))


def ends_of(source: Iterator[Offset], count: int) -> list[Offset]:
    return [next(source) for _ in range(count)]


def _memory() -> str:
    (line,) = (x for x in Path("/proc/self/status").read_text().splitlines() if "VmRSS" in x)
    return f"{int(line.split()[1]) / 1024:.0f} MB resident"


def command(log: Path, *words: str) -> None:
    """The time and the memory of a whole command."""
    program = [sys.executable, "-m", "projections.surfaces.cli", words[0], str(log), *words[1:]]
    program += ["--set", f"eps_m={RULES.eps_m}", "--set", f"min_samples={RULES.min_samples}"]
    seconds, _ = timed(lambda: subprocess.run(program, check=True, capture_output=True))
    say(f"mapfold {' '.join(words)}", f"{seconds:.2f} s")


def grow(log: Path, keyframes: int, detections: int, dim: int) -> None:
    """Add `MORE` events."""
    with LogWriter(log, fsync=parse_fsync("never")) as writer:
        for number, (stamp_ns, payload) in enumerate(payloads(keyframes + MORE, detections, dim)):
            if number >= keyframes:
                writer.append("tb/detections", payload, stamp_ns=stamp_ns)


def run(log: Path, name: str, asks: int) -> None:
    words = [sys.executable, "-m", "scripts.programs.bench.history", "--case", name]
    subprocess.run([*words, "--log", str(log), "--asks", str(asks)], check=True)


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=100_000)
    parser.add_argument("--detections", type=int, default=3)
    parser.add_argument("--dim", type=int, default=512)
    parser.add_argument("--asks", type=int, default=40)
    parser.add_argument("--log", type=Path, help="keep the log here, and use it if it is there")
    parser.add_argument("--no-memory", action="store_true", help="leave out the history in memory")
    parser.add_argument("--kept", action="store_true", help="use the history that is kept already")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case is not None:
        case(options.log, options.case, options.asks)
        return
    with tempfile.TemporaryDirectory() as folder:
        log = options.log or Path(folder) / "log"
        made = (options.keyframes, options.detections, options.dim)
        if not log.exists():
            make_log(log, *made)
        kept = log.with_name(f"{log.name}.history")
        cases: list[Callable[[], None]] = []
        if not options.no_memory:
            cases.append(lambda: run(log, "memory", options.asks))
        if not options.kept:
            shutil.rmtree(kept, ignore_errors=True)
            cases.append(lambda: run(log, "first", options.asks))
        cases.append(lambda: run(log, "later", options.asks))
        for each in cases:
            each()
        say("kept on disk", f"{size_of(kept) / 1e6:.0f} MB; the log {size_of(log) / 1e6:.0f} MB")
        command(log, "merges")
        command(log, "state", "--at", str(options.keyframes // 3), "--no-digest")
        command(log, "state", "--at", str(options.keyframes // 3))
        if options.log is None:
            grow(log, *made)
            run(log, "grown", options.asks)


if __name__ == "__main__":
    main()
