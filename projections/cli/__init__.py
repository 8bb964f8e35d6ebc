"""The ``mapfold`` command: one composition root for both packages' commands.

A command's module is imported when it is that command's turn: all of them together take a third of
a second, longer than most commands work. For the same reason start and end do without what nobody
misses: searching for cycles among things that live as long as the process, and a pool of threads
for matrix products too small to be shared out.
"""

import gc
import importlib
import os
import sys
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import typer

from eventsrc.cli._shell import run_app

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


def command_line(names: Iterable[str] = tuple(COMMANDS)) -> typer.Typer:
    """The program with these commands."""
    app = typer.Typer(
        name="mapfold",
        help="A robot's semantic map as a deterministic fold over an append-only log.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_of_several)
    for name in names:
        importlib.import_module(COMMANDS[name]).register(app)
    return app


def _of_several() -> None:  # without it typer takes a lone command's name for its argument
    pass


def main() -> None:
    """Entry point of the ``mapfold`` program."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported
    gc.disable()
    asked = sys.argv[1:2]
    program = command_line(asked if asked and asked[0] in COMMANDS else COMMANDS)
    gc.freeze()
    gc.enable()
    try:
        run_app(program)
    finally:
        gc.freeze()  # the interpreter would search all of it once more before it goes
