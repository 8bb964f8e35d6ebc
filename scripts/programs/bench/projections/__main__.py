"""`scripts/bench_projections`: everything measured in one run on one machine, as ratios.

Wall times mean little on a busy machine; the load average is printed with them, and CPU seconds of
our own process stand beside the wall seconds.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from projections.postgres.embedded import EmbeddedServer

from . import corrections, floor, live, queries, whole

BENCHES: dict[str, Callable[[EmbeddedServer, Path, bool], None]] = {
    "rebuild": whole.against_naive,
    "growth": whole.growth,
    "floor": floor.against_floor,
    "tail": live.sustained,
    "latency": live.latency,
    "queries": queries.both,
    "corrections": corrections.corrections,
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/bench_projections")
    parser.add_argument("names", nargs="*", choices=[*BENCHES, []], help="default: all")
    parser.add_argument("--quick", action="store_true", help="a tenth of the sizes")
    parser.add_argument("--keep", type=Path, help="folder for logs and server, kept and reused")
    arguments = parser.parse_args()
    folder = arguments.keep or Path(tempfile.mkdtemp(prefix="mapfold-bench-"))
    os.environ["MAPFOLD_HOME"] = str(folder / "home")
    print(
        f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}, {sys.version.split()[0]}"
    )
    try:
        with EmbeddedServer(folder / "home") as server:
            for name in arguments.names or BENCHES:
                started = time.perf_counter()
                BENCHES[name](server, folder, arguments.quick)
                took = time.perf_counter() - started
                print(
                    f"  ({name}: {took:.0f} s, load average {os.getloadavg()[0]:.1f})", flush=True
                )
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
