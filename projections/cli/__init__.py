"""The ``mapfold`` command: one composition root for both packages' commands.

A command's module is imported when it is that command's turn: all of them together take a third of
a second, longer than most commands work. For the same reason start and end do without what nobody
misses: searching for cycles among things that live as long as the process, and a pool of threads
for matrix products too small to be shared out.
"""

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping
from types import FrameType, MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        "demo": "projections.cli.demo",
        "record": "eventsrc.cli.record",
        "import": "eventsrc.cli.import_",
        "log": "eventsrc.cli.log",
        "router": "eventsrc.cli.router",
        "simulate": "eventsrc.cli.simulate",
        "replay": "projections.cli.replay",
        "tail": "projections.cli.tail",
        "status": "projections.cli.status",
        "db": "projections.cli.db",
        "state": "projections.cli.state",
        "relocalize": "projections.cli.relocalize",
        "evaluate": "projections.cli.evaluate",
        "query": "projections.cli.query",
        "serve": "projections.cli.serve",
        "draw": "projections.cli.draw",
        "merges": "projections.cli.merges",
        "why": "projections.cli.why",
        "diff": "projections.cli.diff",
        "bisect": "projections.cli.bisect",
        "whatif": "projections.cli.whatif",
    }
)
"""The module of each command, in the order ``--help`` lists them; its ``register`` adds it."""


def command_line(names: Iterable[str] = tuple(COMMANDS)) -> "typer.Typer":
    """The program with these commands."""
    from ._program import compose  # here, so that `main` is there before typer is

    return compose(names, COMMANDS)


def main() -> None:
    """Entry point of the ``mapfold`` program; it ends by SystemExit."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported
    gc.disable()
    asked = sys.argv[1:2]
    with _starting():
        from eventsrc.cli._program import run_app

        program = command_line(asked if asked and asked[0] in COMMANDS else COMMANDS)
    gc.freeze()
    gc.enable()
    try:
        run_app(program)
    finally:
        gc.freeze()  # the interpreter would search all of it once more before it goes


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Ctrl-C ends a program that only imports at once: an exception might end up anywhere."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is not signal.default_int_handler:  # ignored, or in the hands of who calls `main`
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def _leave(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"mapfold: interrupted\n")
    os._exit(130)
