"""Common parts of all kinds of `mapfold edit`: options, recording a command, and its report."""

import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import shorten_by, visible
from eventsrc.envelope.commands import Command
from eventsrc.log import LogReader
from projections.edit.current import MapToEdit
from projections.edit.effect import cache_effect
from projections.edit.make import Stamp
from projections.edit.record import (
    Made,
    MakeCommand,
    make_command,
    record_command,
    recorded_document,
    void_text,
)
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.settings import Settings
from projections.history.diff_rendering import difference_text

from .folded_log import FoldSettings, settings_from
from .options import JsonOption, ZenohClient, option, user_at_host
from .terminal import display, emit, say

_MOST_LINES = 5


@dataclass(frozen=True, kw_only=True)
class _Stamped:
    """Who gives a command and why, and what is printed."""

    context: typer.Context
    reason: Annotated[str, option("TEXT", "Why; part of the log.")] = ""
    issued_by: Annotated[
        str | None, option("USER@HOST", "Who gives the command [default: your user@host].")
    ] = None
    command_id: Annotated[
        str | None,
        option("ID", "The command's id; given twice, it is recorded once [default: a new one]."),
    ] = None
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would change and record nothing.")
    ] = False
    all_: Annotated[
        bool,
        typer.Option(
            "--all", help=f"With --dry-run: list all changes, not only {_MOST_LINES} of a kind."
        ),
    ] = False
    json: JsonOption = False


@dataclass(frozen=True, kw_only=True)
class NewCommand(ZenohClient, _Stamped):
    """The options that all kinds share: it records a command made of them."""

    def settings(self, corrections: Corrections = NO_CORRECTIONS) -> Settings:
        """The settings of the map that names are looked up in."""
        return settings_from(None, None, corrections)

    def record(self, make_: MakeCommand, *, needs_reason: bool = True) -> None:
        """Record the command, or with ``--dry-run`` print what it would change. Raises MisuseError
        where it needs a reason and has none."""
        if needs_reason and not self.reason.strip() and not self.dry_run:
            raise MisuseError("--reason TEXT is missing: say why, for those who read the log later")
        log: Path = self.context.obj
        stamp = Stamp(
            command_id=uuid.uuid4().hex if self.command_id is None else self.command_id,
            issued_by=user_at_host() if self.issued_by is None else self.issued_by,
            reason=self.reason,
        )

        def make(current: MapToEdit, stamp: Stamp) -> Command:
            shorten_by(current.shortened)
            return make_(current, stamp)

        if self.dry_run:
            with LogReader(log) as reader:
                made = make_command(reader, make, stamp, self.settings, say)
                _show(made, as_json=self.json, most=None if self.all_ else _MOST_LINES)
            return
        made = record_command(log, make, stamp, self.settings, self.session, say)
        keep_effect(made)
        if self.json:
            emit(recorded_document(made))
        else:
            display(recorded_text(made))


@dataclass(frozen=True, kw_only=True)
class EditOptions(FoldSettings, NewCommand):
    """With the options for the settings of the map that names are looked up in."""


def _show(made: Made, *, as_json: bool, most: int | None) -> None:
    """Print what a command would change."""
    difference = made.outcome.change.difference()
    effect = made.outcome.effect or made.outcome.change.effect()
    _say_side_effects(made)
    if as_json:
        emit(
            {
                "command": made.command.model_dump(mode="json", exclude_none=True),
                "offset": made.offset,
                "effect": effect.document(),
                "difference": difference.document(),
            }
        )
        return
    shorten_by(difference.short_ids.text)
    text = difference_text(difference, most=most)
    before, after = (digest[:16] for digest in difference.digests)
    digests = f"the same map, digest {before}" if difference.same else f"digest {before} → {after}"
    details = text.partition("\n")[2]
    display(f"{made.command.kind} would change {effect}; nothing is recorded\n{digests}\n{details}")


def keep_effect(made: Made) -> None:
    """Cache the effect of a recorded command for `mapfold edits`, and report commands that lost
    their effect by it."""
    outcome = made.outcome
    if outcome.effect is not None and made.offset == made.current.end:
        cache_effect(made.current, made.command, outcome.effect)
    _say_side_effects(made)


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


def _say_side_effects(made: Made) -> None:
    """Report commands that have no effect any more, and places of another type."""
    for recorded, why in made.outcome.void:
        say(void_text(recorded, why))
    for line in made.outcome.rooms:
        say(line)
