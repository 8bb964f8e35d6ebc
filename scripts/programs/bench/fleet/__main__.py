"""`scripts/bench_fleet`: ratios of times that were taken in turn, in one run on one machine.

Wall times mean little on a busy machine: the load average is printed with them, ratios are of
neighbours in time, and their median counts.
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

from projections.postgres.embedded import EmbeddedServer

from . import killing, speed, which_site


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/bench_fleet")
    parser.add_argument("names", nargs="*", help="speed, kills, which-site [default: both first]")
    parser.add_argument("--sites", type=int, default=20)
    parser.add_argument("--keyframes", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="folder for logs and server, kept and reused")
    parser.add_argument("--half", choices=["develop", "validate"], default="develop")
    parser.add_argument("--questions", type=int, default=14, help="of a kind from each building")
    arguments = parser.parse_args()
    names = arguments.names or ["speed", "kills"]
    if "which-site" in names:
        which_site.compare(arguments.half, arguments.questions)
        names.remove("which-site")
    if not names:
        return
    folder = arguments.keep or Path(tempfile.mkdtemp(prefix="mapfold-bench-"))
    os.environ["MAPFOLD_HOME"] = str(folder / "home")
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    print(f"{cores} cores, load average {load:.1f}, {sys.version.split()[0]}", flush=True)
    try:
        with EmbeddedServer(folder / "home") as server:
            sites = speed.make_sites(folder / "sites", arguments.sites, arguments.keyframes)
            if "speed" in names:
                speed.compare(speed.template_on(server, "speed"), sites, arguments.rounds)
            if "kills" in names:
                killing.kill_workers(speed.template_on(server, "kills"), sites)
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
