"""Whole rebuilds: against per-node Cypher, and against a tenfold log."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.postgres.embedded import EmbeddedServer

from .naive import write_naively
from .tuned import write_tuned
from .world import make_log

REPEATS = 3


def command_seconds(*arguments: str, home: Path | None = None) -> float:
    """Best of three wall seconds of a whole `mapfold` command, interpreter start and all.

    With a ``home`` of its own it has to start and stop the server as well.
    """
    command = [
        sys.executable,
        "-c",
        "from projections.surfaces.cli import main; main()",
        *arguments,
    ]
    # As installed: pip compiles modules once, some environments forbid Python to.
    compiled = Path(tempfile.gettempdir()) / "mapfold-bench-compiled"
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(compiled)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if home is not None:
        environment["MAPFOLD_HOME"] = str(home)
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
        times.append(time.perf_counter() - started)
    return min(times)


def against_naive(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """2,000 keyframes with three detections: `mapfold replay` against MERGE/CREATE per node."""
    size = 200 if quick else 2_000
    log = make_log(folder / f"log-{size}", size)
    ours = command_seconds("replay", str(log))
    alone = command_seconds("replay", str(log), home=folder / "home-of-its-own")
    with LogReader(log) as reader:
        _, view = fold_log(reader, Settings())
    graph, vectors = write_naively(server.url, view)
    tuned = write_tuned(server.url, view)
    naive = graph + vectors
    print(
        f"rebuild of {size} keyframes: whole command {ours:.2f} s ({alone:.2f} s where it starts"
        f" and stops the server); MERGE per node and edge"
        f" {graph:.1f} s and INSERT per vector {vectors:.1f} s: ratio {naive / ours:.0f};"
        f" tuned, graph only {tuned:.1f} s: ratio {tuned / ours:.0f}"
    )


def growth(server: EmbeddedServer, folder: Path, quick: bool) -> None:
    """time(20,000) / time(2,000); linear is 10."""
    small, large = (200, 2_000) if quick else (2_000, 20_000)
    times = []
    for size in (small, large):
        log = make_log(folder / f"log-{size}", size)
        times.append(command_seconds("replay", str(log), "--no-hnsw"))
    print(f"growth: {small} keyframes {times[0]:.2f} s, {large} keyframes {times[1]:.2f} s;"
          f" ratio {times[1] / times[0]:.1f}")  # fmt: skip
