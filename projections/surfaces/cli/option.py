"""An option of a command, with its metavar and help first."""

from typing import Any

import typer


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """The option ``names`` (by default that of the parameter's name) for an ``Annotated`` type.
    ``more`` is for `typer.Option`."""
    return typer.Option(*names, metavar=metavar, help=text, **more)
