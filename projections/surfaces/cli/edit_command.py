"""Common parts of all kinds of `mapfold edit`: options, recording a command, and its report."""

import dataclasses
import functools
import getpass
import inspect
import os
import socket
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.log import LogReader
from eventsrc.record.transport.session import open_session
from projections.edit.effect import cache_effect
from projections.edit.make import Stamp
from projections.edit.outcome import void_text
from projections.edit.record import Made, MakeCommand, make_command, record_command
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.history.rendering import difference_text

from .options import (
    ConfigOption,
    ConnectOption,
    JsonOption,
    SetOption,
    SettingsOption,
    settings_from,
    zenoh_options,
)
from .terminal import display, emit, say

_MOST_LINES = 5


@dataclasses.dataclass(frozen=True)
class _Common:
    """The values of the options that all kinds share."""

    reason: str
    issued_by: str | None
    command_id: str | None
    dry_run: bool
    all_: bool
    json: bool
    connect: list[str] | None
    zenoh_config: Path | None
    set_: list[str] | None
    settings_file: Path | None

    def settings_of(self, corrections: Corrections) -> Settings:
        """The settings of the map that names are looked up in."""
        return settings_from(self.settings_file, self.set_, corrections)


_COMMON: dict[str, tuple[Any, Any]] = {
    "reason": (
        Annotated[str, typer.Option(metavar="TEXT", help="Why; part of the log.")],
        "",
    ),
    "issued_by": (
        Annotated[
            str | None,
            typer.Option(
                metavar="USER@HOST", help="Who gives the command [default: your user@host]."
            ),
        ],
        None,
    ),
    "command_id": (
        Annotated[
            str | None,
            typer.Option(
                metavar="ID",
                help="The command's id; given twice, it is recorded once [default: a new one].",
            ),
        ],
        None,
    ),
    "dry_run": (
        Annotated[
            bool, typer.Option("--dry-run", help="Print what would change and record nothing.")
        ],
        False,
    ),
    "all_": (
        Annotated[
            bool,
            typer.Option(
                "--all", help=f"With --dry-run: list all changes, not only {_MOST_LINES} of a kind."
            ),
        ],
        False,
    ),
    "json": (JsonOption, False),
    "connect": (ConnectOption, None),
    "zenoh_config": (ConfigOption, None),
    "set_": (SetOption, None),
    "settings_file": (SettingsOption, None),
}


def kind_of(
    app: typer.Typer, name: str, *, settings: bool = True
) -> Callable[[Callable[..., MakeCommand]], Callable[..., MakeCommand]]:
    """Add a subcommand to ``app``.

    The function takes the arguments of the kind and returns the function that makes the command;
    the options that all kinds share are added. Without ``settings`` the options ``--set`` and
    ``--settings`` are those of the function.
    """
    shared = {
        key: value
        for key, value in _COMMON.items()
        if settings or key not in ("set_", "settings_file")
    }

    def add(function: Callable[..., MakeCommand]) -> Callable[..., MakeCommand]:
        @functools.wraps(function)
        def command(context: typer.Context, **values: Any) -> None:
            common = {key: values.pop(key) for key in shared}
            common |= {key: None for key in _COMMON if key not in shared}
            _edit(context.obj, function(**values), _Common(**common))

        own = list(inspect.signature(function, eval_str=True).parameters.values())
        added = [
            inspect.Parameter(
                key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
            )
            for key, (annotation, default) in shared.items()
        ]
        context = inspect.Parameter(
            "context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context
        )
        own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
        parameters = [context, *own, *added]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        app.command(name)(command)
        return function

    return add


def _edit(log: Path, make_: MakeCommand, common: _Common) -> None:
    if not common.reason.strip() and not common.dry_run:
        raise MisuseError("--reason TEXT is missing: say why, for those who read the log later")
    stamp = Stamp(
        command_id=uuid.uuid4().hex if common.command_id is None else common.command_id,
        issued_by=user_at_host() if common.issued_by is None else common.issued_by,
        reason=common.reason,
    )
    if common.dry_run:
        with LogReader(log) as reader:
            _show(make_command(reader, make_, stamp, common.settings_of, say), common)
        return
    options = zenoh_options(common.connect, None, common.zenoh_config)
    made = record_command(
        log,
        make_,
        stamp,
        common.settings_of,
        functools.partial(open_session, options, mode=options.mode),
        say,
    )
    _report(made, common)


def _show(made: Made, common: _Common) -> None:
    """Print what a command would change."""
    difference = made.outcome.change.difference()
    effect = made.outcome.effect or made.outcome.change.effect()
    _say_void(made)
    if common.json:
        emit(
            {
                "command": made.command.model_dump(mode="json", exclude_none=True),
                "offset": made.offset,
                "effect": effect.document(),
                "difference": difference.document(),
            }
        )
        return
    text = difference_text(difference, most=None if common.all_ else _MOST_LINES)
    before, after = (digest[:16] for digest in difference.digests)
    digests = f"the same map, digest {before}" if difference.same else f"digest {before} → {after}"
    details = text.partition("\n")[2]
    display(f"{made.command.kind} would change {effect}; nothing is recorded\n{digests}\n{details}")


def _report(made: Made, common: _Common) -> None:
    """Print the offset of a command, and its effect on the map that it was made from."""
    keep_effect(made)
    if common.json:
        emit(recorded_document(made))
    else:
        display(recorded_text(made))


def keep_effect(made: Made) -> None:
    """Cache the effect of a recorded command for `mapfold edits`, and report commands that lost
    their effect by it."""
    outcome = made.outcome
    if outcome.effect is not None and made.offset == made.current.end:
        cache_effect(made.current, made.command, outcome.effect)
    _say_void(made)


def recorded_document(made: Made) -> dict[str, Any]:
    """JSON of a recorded command: its offset and its effect."""
    effect = made.outcome.effect
    document = {
        "offset": made.offset,
        "command_id": made.command.command_id,
        "repeated": made.repeated,
        "effect": None if effect is None else effect.document(),
    }
    if effect is None:
        document["effect_unknown"] = made.outcome.unknown
    return document


def recorded_text(made: Made) -> str:
    """A line on a recorded command: its offset and its effect."""
    effect = made.outcome.effect
    when = "was recorded before" if made.repeated else "recorded"
    if effect is None:
        changes = f"its effect is not known: {visible(made.outcome.unknown)}"
    elif effect.none:
        changes = "changes nothing in the map as it is"
    else:
        changes = f"changes {effect}"
    command_id = visible(made.command.command_id)
    return f"{made.command.kind} {when} at offset {made.offset}, command {command_id}; {changes}"


def _say_void(made: Made) -> None:
    """Report commands that have no effect any more."""
    for recorded, why in made.outcome.void:
        say(void_text(recorded, why))


def user_at_host() -> str:
    """``user@host``: who gives a command."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # a user id without a name
        name = str(os.getuid())
    return f"{name}@{socket.gethostname()}"
