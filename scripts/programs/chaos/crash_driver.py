"""Run as a program: kill a tail at its n-th step, let another finish, for every n there is
when the tests are thorough, else for every eighty-first.

A step is a statement about to be sent, a transaction about to end, or one that has just ended. Each
round forks a child that tails and kills itself (SIGKILL) at step n, then tails to the end without
harm and compares all rows with those of a rebuild. Prints one JSON line with what it found.

Not a test module of its own because forking wants a process without threads.
"""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import psycopg

from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from tests.support.rows import all_rows
from tests.support.thorough import stride

SETTINGS = Settings()
FROM = 8
BATCH = 9


class Bomb:
    """Goes off at step ``at``, counted over everything psycopg is asked to do."""

    def __init__(self, at: int) -> None:
        self.left = at

    def step(self) -> None:
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        self.left -= 1

    def arm(self) -> None:
        bomb, execute, copy = self, psycopg.Cursor.execute, psycopg.Cursor.copy
        leave = psycopg.Transaction.__exit__

        def stepping_execute(self: Any, *args: Any, **kwargs: Any) -> Any:
            bomb.step()
            return execute(self, *args, **kwargs)

        def stepping_copy(self: Any, *args: Any, **kwargs: Any) -> Any:
            bomb.step()
            return copy(self, *args, **kwargs)

        def stepping_leave(self: Any, *args: Any) -> Any:
            bomb.step()
            result = leave(self, *args)
            bomb.step()
            return result

        psycopg.Cursor.execute = stepping_execute  # type: ignore[method-assign]
        psycopg.Cursor.copy = stepping_copy  # type: ignore[method-assign]
        psycopg.Transaction.__exit__ = stepping_leave  # type: ignore[method-assign]


def killed_at(step: int, log: Path, targets: Targets, batch_events: int = BATCH) -> bool:
    """Tail in a child that dies at ``step``; False when it came to its end before that."""
    child = os.fork()
    if child == 0:
        Bomb(step).arm()
        tail(log, targets, SETTINGS, once=True, batch_events=batch_events)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def main() -> None:
    log, url, other = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    targets = Targets(url, other)
    rebuild(log, targets, SETTINGS)
    expected = all_rows(targets)
    step, wrong = 0, []
    while True:
        rebuild(log, targets, SETTINGS, until=FROM)
        killed = killed_at(step, log, targets)
        tail(log, targets, SETTINGS, once=True)
        if all_rows(targets) != expected:
            wrong.append(step)
        if not killed:
            break
        step += stride(81)
    sys.stdout.write(json.dumps({"steps": step, "wrong": wrong}) + "\n")


if __name__ == "__main__":
    main()
