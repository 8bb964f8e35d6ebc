"""Run as a program: kill a rebuild at its n-th step, for every STRIDE-th n.

Steps are those of `crash_driver`. After each kill a database must hold exactly the old map, or
the new one if the swap was through, and the next rebuild must make the new one. Two databases swap
in a transaction each, so between the two one is new and the other old. Prints one line.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any, TypeAlias

from projections.postgres import rebuild
from projections.postgres.connection import Targets
from scripts.programs.chaos.crash_driver import SETTINGS, Bomb
from tests.support.rows import all_rows
from tests.support.thorough import stride

Rows: TypeAlias = tuple[Any, Any]
"""Of the graph, and of the vectors."""

OLD = 12
STRIDE = 7 * stride(11)
"""Odd, so that kills are spread over kinds of statements that come in groups."""


def killed_at(step: int, log: Path, targets: Targets) -> bool:
    """Rebuild in a child that dies at ``step``; False when it came to its end before that."""
    child = os.fork()
    if child == 0:
        Bomb(step).arm()
        rebuild(log, targets, SETTINGS)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def torn(found: Rows, old: Rows, new: Rows, targets: Targets) -> bool:
    """Whether a database holds anything but its part of the old map or of the new one."""
    if targets.graph_url == targets.vector_url:
        return found not in (old, new)
    return any(part not in maps for part, *maps in zip(found, old, new, strict=True))


def main() -> None:
    log, targets = Path(sys.argv[1]), Targets(sys.argv[2], sys.argv[3])
    rebuild(log, targets, SETTINGS)
    new = all_rows(targets)
    step, wrong, served = 0, [], {"old": 0, "new": 0}
    while True:
        rebuild(log, targets, SETTINGS, until=OLD)
        old = all_rows(targets)
        killed = killed_at(step, log, targets)
        found = all_rows(targets)
        if torn(found, old, new, targets):
            wrong.append(step)
        served["new" if found == new else "old"] += 1
        rebuild(log, targets, SETTINGS)
        if all_rows(targets) != new:
            wrong.append(step)
        if not killed:
            break
        step += STRIDE
    sys.stdout.write(json.dumps({"steps": step, "wrong": wrong, **served}) + "\n")


if __name__ == "__main__":
    main()
