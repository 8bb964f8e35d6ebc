"""Check that a projection was made from this log with these settings and corrections; what to run
if it was not."""

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

from pydantic import ValidationError

from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader, event_hash
from projections.fold.map_errors import ProjectionMismatch, ProjectionMissing
from projections.fold.settings import Settings, settings_by_name

from .inputs import LogInputs, MapInputs
from .labels import SINKS, SinkName
from .sink import Checkpoint

_SETTINGS_OPTIONS: Final = ("--settings", "--preset", "--set")

Fault: TypeAlias = Literal["log", "settings", "corrections"]
"""The part of a projection's origin that differs from the expected one."""


def command_line(
    name: str, log: Path, settings: Settings, *options: str, logged: Settings | None = None
) -> str:
    """``mapfold NAME LOG`` with ``options``, and ``--set`` for each setting that differs from the
    command's own: the log's settings ``logged``, or the defaults."""
    changed = settings.changed_from(logged or Settings())
    return advised(name, log, *options, *_words(changed), without=_SETTINGS_OPTIONS)


def command_for(name: str, log: Path, inputs: MapInputs, *options: str) -> str:
    """`command_line` that makes the map of ``inputs``."""
    return command_line(name, log, inputs.settings, *options, logged=inputs.logged)


def replay_advice(log: Path, inputs: MapInputs) -> str:
    """Advice for a projection that does not match the log, the settings or corrections."""
    return f"to rebuild the map run: {command_for('replay', log, inputs)}"


def _settings_differences(before: str, settings: Settings) -> list[str]:
    """Settings that differ from a checkpoint's, as text: ``eps_m=0.75 there, 1.5 here``."""
    default = Settings().by_name()  # of those younger than the checkpoint
    old, new = default | settings_by_name(json.loads(before)), settings.by_name()
    changed = [name for name in sorted(old | new) if old.get(name) != new.get(name)]
    return [f"{name}={old.get(name)} there, {new.get(name)} here" for name in changed] or [
        "made by another version"
    ]


def _options_to_match(before: str, settings: Settings) -> str | None:
    """The ``--set`` options that turn ``settings`` into a checkpoint's; None if none can."""
    old = _settings_of(before)
    if old is None:
        return None
    changed = old.changed_from(settings)
    return shlex.join(_words(dict(sorted(changed.items())))) or None


def _settings_of(document: str) -> Settings | None:
    """A checkpoint's settings; None if this version cannot read them."""
    try:
        return Settings.model_validate_json(document)
    except ValidationError:
        return None


def _words(values: Mapping[str, Any]) -> list[str]:
    pairs = [("--set", f"{name}={_option_value(value)}") for name, value in values.items()]
    return [word for pair in pairs for word in pair]


def _option_value(value: object) -> str:
    return "none" if value is None else str(value)


def origin_fault(found: Checkpoint, log_id: str, inputs: MapInputs) -> Fault | None:
    """The part of a checkpoint's origin that differs from ``log_id`` and ``inputs``; None if none
    does."""
    if found.log_id != log_id:
        return "log"
    if found.fingerprint == inputs.fingerprint:
        return None
    return "corrections" if _settings_of(found.settings) == inputs.settings else "settings"


def refuse_other_origin(
    found: Checkpoint, sink: SinkName, where: str, log_id: str, inputs: MapInputs, advice: str
) -> None:
    """Raise ProjectionMismatch when a checkpoint was made from another log, with other settings or
    under other corrections."""
    made = f"{where}: the {sink} there {SINKS[sink].was} made"
    fault = origin_fault(found, log_id, inputs)
    if fault == "log":
        raise ProjectionMismatch(f"{made} from log {found.log_id}, not from {log_id}; {advice}")
    if fault == "corrections":
        raise ProjectionMismatch(
            f"{made} under other corrections than the log's commands before offset"
            f" {found.known_at:,} give; {advice}"
        )
    if fault is not None:
        options = _options_to_match(found.settings, inputs.settings)
        raise ProjectionMismatch(
            f"{made} with other settings"
            f" ({', '.join(_settings_differences(found.settings, inputs.settings))});"
            f"{f' to go on with them give {options} instead;' if options else ''} {advice}"
        )


def refuse_mismatch(
    found: Checkpoint, sink: SinkName, where: str, log: Path, reader: LogReader, inputs: MapInputs
) -> None:
    """Raise ProjectionMismatch unless ``found`` was made from this log, as it is, and ``inputs``,
    which are as of the checkpoint's `Checkpoint.known_at`.

    ``where`` names the database in the message.
    """
    advice = replay_advice(log, inputs)
    refuse_other_origin(found, sink, where, reader.log_id, inputs, advice)
    refuse_other_events(found, sink, where, log, reader, advice)


def is_under_other_corrections(
    found: Checkpoint, sink: SinkName, where: str, log: Path, reader: LogReader, known: LogInputs
) -> bool:
    """Whether ``found`` was made from this log, as it is, under other corrections than its commands
    give. Raises ProjectionMismatch for another log or other settings."""
    inputs = known.at(found.known_at)
    if origin_fault(found, reader.log_id, inputs) != "corrections":
        refuse_mismatch(found, sink, where, log, reader, inputs)
        return False
    refuse_other_events(found, sink, where, log, reader, replay_advice(log, known.latest))
    return True


def refuse_other_events(
    found: Checkpoint, sink: SinkName, where: str, log: Path, reader: LogReader, advice: str
) -> None:
    """Raise ProjectionMismatch unless the log still has the events of a checkpoint."""
    if found.next_offset > reader.end_for(found.next_offset):
        raise ProjectionMismatch(
            f"{where}: {found.next_offset:,} events are in the {sink} there, but {log} has only"
            f" {reader.next_offset:,}; {advice}"
        )
    for event in reader.read(max(FIRST_OFFSET, Offset(found.next_offset - 1)), found.next_offset):
        if event_hash(event) != found.last_event:
            raise ProjectionMismatch(
                f"{log}: the event at offset {event.offset:,} is not the one that is in the"
                f" {sink}; {advice}"
            )


def rows_dropped(
    found: Checkpoint, sink: SinkName, where: str, log: Path, inputs: MapInputs
) -> ProjectionMissing:
    """The error for a checkpoint whose graph or table was dropped."""
    return ProjectionMissing(
        f"{where}: the checkpoint of the {sink} has {found.next_offset:,} events, but their"
        f" tables were dropped; {replay_advice(log, inputs)}"
    )
