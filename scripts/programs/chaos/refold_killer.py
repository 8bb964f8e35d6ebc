"""Run as a program: kill a tail at its n-th step, for every STRIDE-th n, in a log with commands.

Steps are those of `crash_driver`, also those of the threads that load and that tell the progress.
The old map knows none of the commands. After each kill a database must hold exactly the old map, or
the new one if the swap was through; the next tail must come to the rows of a fresh replay. Two
databases swap in a transaction each, so between the two one is new and the other old. Where all
commands name places there is no swap, and batches are written one by one. Prints one line.
"""

import json
import sys
from pathlib import Path

from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from scripts.programs.chaos.crash_driver import SETTINGS, killed_at
from scripts.programs.chaos.rebuild_killer import torn
from tests.support.rows import all_rows

BATCH = 4


def main() -> None:
    log, targets = Path(sys.argv[1]), Targets(sys.argv[2], sys.argv[3])
    old_end, stride, swaps = int(sys.argv[4]), int(sys.argv[5]), sys.argv[6] == "swaps"
    rebuild(log, targets, SETTINGS)
    new = all_rows(targets)
    step, wrong, served = 0, [], {"old": 0, "new": 0}
    while True:
        rebuild(log, targets, SETTINGS, until=old_end)  # type: ignore[arg-type]
        old = all_rows(targets)
        killed = killed_at(step, log, targets, BATCH)
        found = all_rows(targets)
        if swaps and torn(found, old, new, targets):
            wrong.append(step)
        served["new" if found == new else "old"] += 1
        tail(log, targets, SETTINGS, once=True)
        if all_rows(targets) != new:
            wrong.append(step)
        if not killed:
            break
        step += stride
    sys.stdout.write(json.dumps({"steps": step, "wrong": wrong, **served}) + "\n")


if __name__ == "__main__":
    main()
