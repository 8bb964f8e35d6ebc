"""From the start of the process to the command, and out of it.

A command's module is imported when it is that command's turn: all of them together take a third of
a second, longer than most commands work. For the same reason start and end do without what nobody
misses: searching for cycles among things that live as long as the process, and a pool of threads
for matrix products too small to be shared out.

Composing the ``mapfold`` program out of the commands' modules.
"""

import contextlib
import gc
import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import FrameType
from typing import Annotated, Any

import typer

from .program import Program


def start(
    command_line: Callable[[Mapping[str, str]], Callable[..., Any]], commands: Mapping[str, str]
) -> None:
    """Run the command that was asked for out of ``commands``; ends by SystemExit."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported
    gc.disable()
    asked = sys.argv[1:2]
    with _starting():
        from .program import run_app

        one = {asked[0]: commands[asked[0]]} if asked and asked[0] in commands else commands
        program = command_line(one)
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


def compose(names: Iterable[str], modules: Mapping[str, str]) -> typer.Typer:
    """The program with these commands; ``register`` in the module of each adds it."""
    app = typer.Typer(
        name="mapfold",
        cls=Program,
        help="A robot's semantic map as a deterministic fold over an append-only log.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_of_several)
    for name in names:
        importlib.import_module(modules[name]).register(app)
    return app


def _say_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # here: it takes as long to import as typer does

        sys.stdout.write(f"mapfold {version('mapfold')}\n")
        raise typer.Exit


def _of_several(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", help="Say which mapfold this is.", callback=_say_version, is_eager=True
        ),
    ] = False,
) -> None:  # without it typer takes a lone command's name for its argument
    pass
