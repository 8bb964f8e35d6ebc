"""Groups of options: the signature of a command for typer, and the groups that it is given."""

import inspect
from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from projections.surfaces.cli.composition import flattened


@dataclass(frozen=True, kw_only=True)
class Sized:
    size: Annotated[int, typer.Option("--size")] = 3


@dataclass(frozen=True, kw_only=True)
class Placed(Sized):
    room: Annotated[str, typer.Argument()]
    floor: Annotated[str | None, typer.Option("--floor")] = None


def command(
    *,
    thing: Annotated[str, typer.Argument()],
    before: bool = False,
    placed: Placed,
    after: Annotated[bool, typer.Option("--after")] = False,
) -> None:
    """Print what was given."""
    typer.echo((thing, before, placed, after))


def test_options_stand_where_the_group_stands_and_its_arguments_come_first() -> None:
    parameters = inspect.signature(flattened(command)).parameters
    assert list(parameters) == ["room", "thing", "before", "size", "floor", "after"]
    assert parameters["room"].default is inspect.Parameter.empty
    assert (parameters["size"].default, parameters["floor"].default) == (3, None)


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (["hall", "cup"], ("cup", False, Placed(room="hall"), False)),
        (
            ["hall", "cup", "--floor", "1", "--size", "4", "--after"],
            ("cup", False, Placed(room="hall", floor="1", size=4), True),
        ),
    ],
)
def test_a_command_is_given_its_group(words: list[str], given: Any) -> None:
    app = typer.Typer()
    app.command()(flattened(command))
    done = CliRunner().invoke(app, words)
    assert (done.exit_code, done.output) == (0, f"{given}\n")


def test_the_command_keeps_its_name_and_help() -> None:
    made = flattened(command)
    assert (made.__name__, made.__doc__) == ("command", command.__doc__)


def test_a_command_without_groups_and_one_that_was_flattened_stay_themselves() -> None:
    def plain(size: int = 3) -> None: ...

    assert flattened(plain) is plain
    made = flattened(command)
    assert flattened(made) is made
