"""Composing the ``mapfold`` program out of the commands' modules."""

import importlib
import sys
from collections.abc import Iterable, Mapping
from typing import Annotated

import typer

from eventsrc.cli._program import Program


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
