"""A `mapfold` that kills itself with SIGKILL at a given call that changes files, here or in a
store: the same moment each time."""

import os
import signal
import sys
from typing import Any

from eventsrc.base.object_store import ObjectStore

DYING = "tests.support.dying:main"
"""What `prefork.start` starts; its first argument is the number of calls to survive."""
_CHANGING = {f"os.{name}" for name in ("rename", "remove", "mkdir", "symlink", "rmdir")}
_STORE_CALLS = ("put_new", "replace", "delete", "part", "blocks", "sizes")


def main() -> None:
    """Run a command."""
    from projections.surfaces.cli import main

    die_at(int(sys.argv.pop(1)))
    main()


def die_at(calls: int) -> None:
    """Kill this process at its call of this number, counted from 0, that changes files or asks a
    store."""
    left = calls

    def call() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def watch(event: str, args: tuple[Any, ...]) -> None:
        flags = args[2] if event == "open" and isinstance(args[2], int) else 0
        if event in _CHANGING or flags & (os.O_WRONLY | os.O_RDWR):
            call()

    for name in _STORE_CALLS:
        setattr(ObjectStore, name, _counted(getattr(ObjectStore, name), call))
    sys.addaudithook(watch)


def _counted(method: Any, call: Any) -> Any:
    def counted(*args: Any, **more: Any) -> Any:
        call()
        return method(*args, **more)

    return counted
