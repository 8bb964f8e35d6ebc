"""Compare all ways to a map on random logs, and report the differences."""

import argparse
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from itertools import count
from pathlib import Path

from projections.fold.settings import Settings
from projections.postgres.embedded import EmbeddedServer
from tests.property.test_timeline_cache import kept_early
from tests.support.servers import server_to_kill

from .databases import DatabaseWays
from .growing_log import GrowingLog
from .outcomes import CHOICES, Chosen, Tally
from .timelines import TimelineWays

_SIZES = (5, 10, 20, 40, 80)
"""Events of a log; a failing one is tried again with fewer."""
_MOST_FAILURES = 5
_WAYS = ("databases", "interrupts", "threads")
"""Ways that can be left out."""


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when all ways agreed, 1 when two differed."""
    args = _parsed(arguments)
    tally, failures = Tally(), 0
    with ExitStack() as stack:
        server = None if "databases" in args.without else stack.enter_context(server_to_kill())
        end = time.monotonic() + args.seconds
        for number in count() if args.log is None else (args.log,):
            if args.log is None and (time.monotonic() >= end or failures == _MOST_FAILURES):
                break
            rng = random.Random(f"size {args.seed} {number}")
            size = args.events or rng.choice(_SIZES[1:])
            if (fault := _fault_of(args.seed, number, size, server, tally, args.without)) is None:
                continue
            failures += 1
            size, fault = _shortest(args.seed, number, size, server, args.without) or (size, fault)
            kept = Path(tempfile.mkdtemp(prefix="mapfold-differ-")) / "log"
            [*GrowingLog(kept, _log_seed(args.seed, number), size).grow()]
            print(f"log {number} of {size} events DIFFERS; it is kept at {kept}\n{fault}")
            print(f"to repeat: scripts/differ --seed {args.seed} --log {number} --events {size}")
            sys.stdout.flush()
    ways = ", ".join(f"{way} {times:,}" for way, times in sorted(tally.by_way.items()))
    print(f"compared: {ways}")
    print(
        f"seed {args.seed}: {tally.logs:,} logs, {tally.prefixes:,} prefixes,"
        f" {tally.comparisons:,} comparisons, {failures:,} of the logs with a difference;"
        f" all of it again: scripts/differ --seed {args.seed}"
    )
    return 1 if failures else 0


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/differ", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="begin no log after these")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--log", type=int, help="compare on this log and no other")
    parser.add_argument("--events", type=int, help="the length of each log")
    names = ", ".join(_WAYS)
    parser.add_argument("--without", nargs="+", choices=_WAYS, default=[], help=f"{names}")
    return parser.parse_args(arguments)


def _log_seed(seed: int, number: int) -> int:
    return seed * 10**6 + number


def _fault_of(
    seed: int,
    number: int,
    size: int,
    server: EmbeddedServer | None,
    tally: Tally,
    without: Sequence[str],
) -> str | None:
    """Compare on one log; the first difference or unexpected error as text, None if all agree."""
    rng = random.Random(f"ways {seed} {number}")
    name, *assignments = rng.choice(CHOICES)
    settings = Chosen(Settings().with_assignments(assignments))
    folder = Path(tempfile.mkdtemp(prefix="mapfold-differ-"))
    log = folder / "log"
    try:
        databases = (
            nullcontext()
            if server is None
            else DatabaseWays(log, settings, rng, tally, server).opened()
        )
        with (
            kept_early(),
            TimelineWays(log, settings, rng, tally, without) as timelines,
            databases as followed,
        ):
            for end in GrowingLog(log, _log_seed(seed, number), size).grow():
                tally.prefixes += 1
                timelines.ask(end)
                if followed is not None:
                    followed.follow()
            if followed is not None:
                followed.compare(end)
    except Exception:  # noqa: BLE001  # reported in full
        return f"settings: {name}\n{traceback.format_exc()}"
    finally:
        shutil.rmtree(folder)
    tally.logs += 1
    return None


def _shortest(
    seed: int, number: int, size: int, server: EmbeddedServer | None, without: Sequence[str]
) -> tuple[int, str] | None:
    """The shortest of some logs that differs too, and how; None if no shorter one does."""
    for shorter in (each for each in _SIZES if each < size):
        fault = _fault_of(seed, number, shorter, server, Tally(), without)
        if fault is not None:
            return shorter, fault
    return None


if __name__ == "__main__":
    sys.exit(main())
