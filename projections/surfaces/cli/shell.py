"""`mapfold help` and `mapfold completion`: help texts and shell completion."""

import sys
from enum import StrEnum
from typing import Annotated

import typer

from .program import COMPLETION_VARIABLE


class Shell(StrEnum):
    """A shell whose command line can be completed."""

    bash = "bash"
    zsh = "zsh"
    fish = "fish"


def help_(
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="COMMAND", help="A command, such as db check.", show_default=False),
    ] = None,
) -> None:
    """Show the help of a command, as its --help does."""
    from . import command_line  # here: the module of all commands names this one

    command_line()([*(command or ()), "--help"], prog_name="mapfold")


def completion(
    shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")],
) -> None:
    """Print a script that completes commands and options in a shell.

    \b
        bash   eval "$(mapfold completion bash)"       in ~/.bashrc
        zsh    eval "$(mapfold completion zsh)"        in ~/.zshrc, after compinit
        fish   mapfold completion fish | source        in ~/.config/fish/config.fish
    """
    from typer._completion_shared import get_completion_script

    script = get_completion_script(
        prog_name="mapfold", complete_var=COMPLETION_VARIABLE, shell=shell.value
    )
    sys.stdout.write(f"{script}\n")
