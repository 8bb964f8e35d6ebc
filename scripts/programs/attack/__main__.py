"""Attack the real commands and report what held: see `scripts.programs.attack`."""

import argparse
import random
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from itertools import count
from pathlib import Path

from tests.support.servers import server_to_kill

from .arena import Arena
from .attacks import ATTACKS
from .tally import Tally, table


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when everything held, 1 when something did not."""
    args = _parsed(arguments)
    names = args.only or list(ATTACKS)
    # Both sides need descriptors for many connections; a child has its parent's limit.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 8192) if most > 0 else 8192, most))
    tallies = {name: Tally(name) for name in names}
    with ExitStack() as stack:

        @cache
        def database() -> str:
            return stack.enter_context(server_to_kill()).url

        for number, name in _schedule(names, args.seconds, args.round):
            _play_round(name, number, args.seed, tallies[name], database)
    print(table([*tallies.values()]))
    repeat = f"scripts/attack --seed {args.seed}"
    for tally in tallies.values():
        for complaint in tally.complaints:
            print(f"{tally.name}, {complaint}")
        if not tally.held:
            print(f"to repeat: {repeat} --only {tally.name}")
    held = all(tally.held for tally in tallies.values())
    print(f"{'held' if held else 'VIOLATED'}; seed {args.seed}, all of it again: {repeat}")
    return 0 if held else 1


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/attack", description=__doc__)
    parser.add_argument("--seconds", type=float, default=180.0, help="begin no round after these")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--only", nargs="+", choices=list(ATTACKS), metavar="NAME")
    parser.add_argument("--round", type=int, help="play this round and no other")
    return parser.parse_args(arguments)


def _schedule(
    names: Sequence[str], seconds: float, only_round: int | None
) -> Iterator[tuple[int, str]]:
    """Every attack's cases once; then random rounds of them in turn until the time is up."""
    end = time.monotonic() + seconds
    for number in count() if only_round is None else (only_round,):
        for name in names:
            if number and only_round is None and time.monotonic() >= end:
                return
            yield number, name


def _play_round(
    name: str, number: int, seed: int, tally: Tally, database: Callable[[], str]
) -> None:
    begun = time.monotonic()
    rng = random.Random(f"{seed} {name} {number}")
    with (
        tempfile.TemporaryDirectory(prefix="mapfold-attack-") as folder,
        Arena(Path(folder), number, rng, tally, database) as arena,
    ):
        arena.attempt("it", lambda: ATTACKS[name](arena))
    tally.rounds += 1
    took = time.monotonic() - begun
    print(f"{name}, round {number}: {'held' if tally.held else 'NO'} ({took:.1f} s)", flush=True)


if __name__ == "__main__":
    sys.exit(main())
