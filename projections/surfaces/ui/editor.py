"""Corrections: list them, and make new ones, first as a dry run, then recorded with a reason.

The body of ``POST /api/edit`` is ``{"kind", "arguments", "reason", "dry_run", "command_id"}``. The
arguments of a kind are those of ``mapfold edit LOG KIND``, in that order. A command goes into the
log itself, or to the recorder that holds it; ``--connect`` of ``mapfold ui`` says where that is.
"""

import functools
import json
import uuid
from collections.abc import Callable
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, StrictStr, ValidationError

from eventsrc.base.errors import LogError, MisuseError
from eventsrc.base.text import counted, visible, visible_lines
from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset, describe_error
from projections.edit import make
from projections.edit.correct_poses import Span, by_transform
from projections.edit.current import MapToEdit
from projections.edit.effect import cache_effect, edits_document, edits_text, effects_of
from projections.edit.make import Stamp, labels_of
from projections.edit.record import (
    Made,
    MakeCommand,
    OpenSession,
    make_command,
    record_command,
    void_text,
)
from projections.fold.map_errors import QuestionError
from projections.fold.settings import Settings
from projections.history.diff_rendering import difference_text
from projections.map.view import MapView
from projections.surfaces.text_encoders import with_text_encoder

from .comparisons import MOST_LINES
from .log_map import Opened, PrefixReader
from .requests import command_line, lines_of

MOST_BYTES: Final = 64 * 1024
_MOST_ARGUMENTS: Final = 1000


class Edit(BaseModel):
    """The body of a request."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: StrictStr
    arguments: Annotated[list[StrictStr], Field(max_length=_MOST_ARGUMENTS)] = []
    reason: Annotated[StrictStr, Field(max_length=2000)] = ""
    dry_run: bool = True
    command_id: StrictStr | None = None


class _Kind:
    """A kind: the names of its arguments, a last one with … for several, and what makes it."""

    def __init__(self, names: str, make_: Callable[..., MakeCommand]) -> None:
        self.names, self.make = names.split(), make_

    def command(self, kind: str, arguments: list[str]) -> MakeCommand:
        several = bool(self.names) and self.names[-1].endswith("…")
        least, given = len(self.names), len(arguments)
        if given < least or (given > least and not several):
            wanted = " ".join(self.names).upper()
            there = counted(given, "argument")
            raise QuestionError(f"{kind} has {there}; give {wanted or 'none'}")
        return self.make(*arguments)


def _of(function: Callable[..., Any]) -> Callable[..., MakeCommand]:
    """A maker of commands from text arguments."""
    return lambda *arguments: lambda current, stamp: function(current, stamp, *arguments)


def _drop_detections(*det_ids: str) -> MakeCommand:
    return lambda current, stamp: make.drop_detection(current, stamp, det_ids)


def _undo_merge(offset: str) -> MakeCommand:
    if not (offset.isascii() and offset.isdecimal() and len(offset) <= 18):
        raise QuestionError(f"undo-merge takes the offset of a merge, not {offset[:40]!r}")
    return lambda current, stamp: make.undo_merge(current, stamp, int(offset))


def _correct_poses(run: str, dx: str, dy: str, dyaw: str) -> MakeCommand:
    moves = [_metres(text) for text in (dx, dy, dyaw)]
    return lambda current, stamp: by_transform(current, stamp, run, Span(None, None), *moves)


def _metres(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise QuestionError(f"{text[:40]!r} is no number") from None


def _use_settings(*assignments: str) -> MakeCommand:
    def command(current: Any, stamp: Stamp) -> Any:
        logged: Settings = current.corrections.settings or Settings()
        settings = with_text_encoder(logged.with_assignments(assignments), current)
        return make.use_settings(current, stamp, settings)

    return command


def _relabel(*assignments: str) -> MakeCommand:
    labels = labels_of(assignments)
    return lambda current, stamp: make.relabel(current, stamp, labels)


KINDS: Final = {
    "name-place": _Kind("place name", _of(make.name_place)),
    "keep-apart": _Kind("place place", _of(make.keep_apart)),
    "undo-merge": _Kind("offset", _undo_merge),
    "join": _Kind("place place", _of(make.join)),
    "same-object": _Kind("object object", _of(make.same_object)),
    "different-objects": _Kind("object object", _of(make.different_objects)),
    "drop-object": _Kind("object", _of(make.drop_object)),
    "drop-detection": _Kind("det_id…", _drop_detections),
    "forget-run": _Kind("run", _of(make.forget_run)),
    "forget-keyframes": _Kind("run a..b", _of(make.forget_keyframes)),
    "correct-poses": _Kind("run dx dy dyaw", _correct_poses),
    "relabel": _Kind("label=name…", _relabel),
    "use-settings": _Kind("name=value…", _use_settings),
    "undo": _Kind("command_id", _of(make.undo)),
}
"""The kinds of `mapfold edit` that the page can give; of ``correct-poses`` those by a transform."""
NEEDS_NO_REASON: Final = frozenset({"name-place", "relabel"})


def corrections_answer(opened: Opened, through: int, go_on: Callable[[], None]) -> dict[str, Any]:
    """The commands among the first ``through`` events: author, reason, effect, and whether it is
    undone. Effects are given only where they are known already."""
    with PrefixReader(opened.log, Offset(through), go_on) as reader:
        current = MapToEdit(reader, opened.settings)
        found = effects_of(current, known_only=True)
        times = {event.offset: event.logged_ns for event in current.command_events()}
    go_on()
    return {
        "through": through,
        "corrections": [
            {**each, "text": visible(f"{each['kind']} {each['what']}")}
            for each in edits_document(found, times)
        ],
        "kinds": [{"kind": kind, "arguments": each.names} for kind, each in KINDS.items()],
        "lines": visible_lines(edits_text(found, times)).splitlines(),
        "command": command_line(opened, "edits", *opened.words()),
    }


class Editor:
    """Makes and records commands. Not for several threads at once."""

    def __init__(
        self, opened: Opened, log_id: str, open_session: OpenSession, issued_by: str
    ) -> None:
        self._opened, self._log_id = opened, log_id
        self._open_session, self._issued_by = open_session, issued_by

    def answer(
        self,
        through: int,
        asked: Edit,
        go_on: Callable[[], None],
        maps_of: Callable[[Offset], MapView] | None = None,
    ) -> dict[str, Any]:
        """The effect of a command, of a dry run or recorded. ``go_on`` ends a dry run by
        raising. ``maps_of`` gives the map after so many events, where it is folded already."""
        if asked.kind not in KINDS:
            raise QuestionError(f"no edit {asked.kind[:40]!r}; there are {', '.join(KINDS)}")
        maps: list[MapToEdit] = []
        make_ = self._checked(KINDS[asked.kind].command(asked.kind, asked.arguments), maps, maps_of)
        if asked.kind not in NEEDS_NO_REASON and not asked.reason.strip() and not asked.dry_run:
            raise MisuseError("the reason is missing: say why, for later readers of the log")
        stamp = Stamp(asked.command_id or uuid.uuid4().hex, self._issued_by, asked.reason)
        notes: list[str] = []
        log, settings = self._opened.log, self._opened.settings
        try:
            if asked.dry_run:
                reader = PrefixReader(log, go_on=go_on)
                if maps_of is not None:
                    reader.limit = Offset(through)
                with reader:
                    made = make_command(reader, make_, stamp, settings, notes.append)
                    return self._document(through, asked, made, notes)
            made = record_command(log, make_, stamp, settings, self._open_session, notes.append)
        except MisuseError as error:
            if maps:  # ids are as short as the command prints them
                error.args = (maps[-1].shortened(str(error)),)
            raise
        effect = made.outcome.effect
        if effect is not None and made.offset == made.current.end:
            cache_effect(made.current, made.command, effect)
        return self._document(through, asked, made, notes)

    def _checked(
        self,
        make_: MakeCommand,
        maps: list[MapToEdit],
        maps_of: Callable[[Offset], MapView] | None,
    ) -> MakeCommand:
        """``make_``, refusing a log other than the one that the page shows; adds to ``maps`` those
        that it is made from."""

        def checked(current: MapToEdit, stamp: Stamp) -> Command:
            if current.reader.log_id != self._log_id:
                raise LogError(
                    f"there is another log at {self._opened.log} now; start mapfold ui again"
                )
            if maps_of is not None:
                current.use_maps(functools.partial(maps_of, current.end))
            maps.append(current)
            return make_(current, stamp)

        return checked

    def _document(self, through: int, asked: Edit, made: Made, notes: list[str]) -> dict[str, Any]:
        outcome = made.outcome
        effect = outcome.effect
        if effect is None and asked.dry_run:
            effect = outcome.change.effect()
        notes += [void_text(recorded, why) for recorded, why in outcome.void]
        notes += outcome.rooms
        found = {
            "through": through,
            "recorded": not asked.dry_run,
            "repeated": made.repeated,
            "offset": made.offset,
            "command_id": made.command.command_id,
            "effect": None if effect is None else effect.document(),
            "effect_text": visible(str(outcome.unknown if effect is None else effect)),
            "notes": [visible(note) for note in notes],
            "command": self._command(asked),
        }
        if asked.dry_run:
            difference = outcome.change.difference()
            found["difference"] = difference.document()
            text = difference_text(difference, most=MOST_LINES)
            found["lines"] = lines_of(text, difference.short_ids)
        return found

    def _command(self, asked: Edit) -> str:
        arguments = asked.arguments
        if asked.kind == "correct-poses":
            run, dx, dy, dyaw = arguments
            arguments = [run, "--dx", dx, "--dy", dy, "--dyaw", dyaw]
        if asked.kind == "use-settings":
            arguments = [word for text in arguments for word in ("--set", text)]
        words = ["--dry-run"] if asked.dry_run else ["--reason", asked.reason]
        if asked.kind != "use-settings":
            words += self._opened.words()
        if asked.kind not in ("correct-poses", "use-settings"):
            words.append("--")  # a name may begin with a hyphen
        return command_line(self._opened, "edit", asked.kind, *words, *arguments)


def read_edit(payload: bytes) -> Edit:
    """The body of a request. Raises QuestionError."""
    try:
        return Edit.model_validate(json.loads(payload))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "the edit"
        raise QuestionError(f"{field}: {describe_error(first).lower()}") from None
    except (ValueError, RecursionError) as error:
        raise QuestionError(f"the edit is not JSON: {error}") from None
