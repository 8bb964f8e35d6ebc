"""Check that a projection was made from this log with these settings; what to run if it was not."""

import json
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.errors import ProjectionMismatch, ProjectionMissing
from projections.settings import Settings

from .checkpoints import event_hash
from .sink import Checkpoint, SinkName

_WAS: Final[dict[SinkName, str]] = {"graph": "was", "vectors": "were"}
_NOT_AN_OPTION: Final = "neighbourhood"
"""The setting that ``--set`` does not take."""


def command_line(name: str, log: Path, settings: Settings, *options: str) -> str:
    """``mapfold NAME LOG`` with ``options``, and ``--set`` for all that is not the default."""
    " default."
    default = Settings().model_dump()
    changed = [key for key, value in settings.model_dump().items() if value != default[key]]
    words = ["mapfold", name, shlex.quote(str(log)), *options, *_options(settings, changed)]
    return " ".join(words)


def replay_advice(log: Path, settings: Settings) -> str:
    """What to do about a projection that does not match the log or the settings."""
    return f"to make the map anew run: {command_line('replay', log, settings)}"


def _settings_differences(before: str, settings: Settings) -> list[str]:
    """Settings that differ from a checkpoint's, as text: ``eps_m=0.75 there, 1.5 here``."""
    old, new = json.loads(before), json.loads(settings.model_dump_json())
    return [
        f"{name}={old.get(name)} there, {new.get(name)} here" for name in _changed_names(old, new)
    ] or ["made by another version"]


def _options_to_match(before: str, settings: Settings) -> str | None:
    """The ``--set`` options that turn ``settings`` into a checkpoint's; None if none can."""
    try:
        old = Settings.model_validate_json(before)
    except ValidationError:
        return None
    changed = _changed_names(old.model_dump(), settings.model_dump())
    if _NOT_AN_OPTION in changed:
        return None
    return " ".join(_options(old, changed)) or None


def _options(settings: Settings, names: Iterable[str]) -> list[str]:
    values = settings.model_dump()
    return [
        f"--set {shlex.quote(f'{name}={_option_value(values[name])}')}"
        for name in names
        if name != _NOT_AN_OPTION
    ]


def _option_value(value: object) -> str:
    return "none" if value is None else str(value)


def _changed_names(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    return [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]


def refuse_other_origin(
    found: Checkpoint, sink: SinkName, where: str, log_id: str, settings: Settings, advice: str
) -> None:
    """Raise ProjectionMismatch when a checkpoint was made from another log or other settings."""
    if found.log_id != log_id:
        raise ProjectionMismatch(
            f"{where}: the {sink} there {_WAS[sink]} made from log {found.log_id}, not from"
            f" {log_id}; {advice}"
        )
    if found.fingerprint != settings.fingerprint():
        options = _options_to_match(found.settings, settings)
        raise ProjectionMismatch(
            f"{where}: the {sink} there {_WAS[sink]} made with other settings"
            f" ({', '.join(_settings_differences(found.settings, settings))});"
            f"{f' to go on with them add {options};' if options else ''} {advice}"
        )


def refuse_mismatch(
    found: Checkpoint, sink: SinkName, where: str, log: Path, reader: LogReader, settings: Settings
) -> None:
    """Raise ProjectionMismatch unless ``found`` was made from this log, as it is, and ``settings``.

    ``where`` names the database in the message.
    """
    advice = replay_advice(log, settings)
    refuse_other_origin(found, sink, where, reader.log_id, settings, advice)
    if found.next_offset > reader.next_offset:
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
    found: Checkpoint, sink: SinkName, where: str, log: Path, settings: Settings
) -> ProjectionMissing:
    """The error for a checkpoint whose graph or table was dropped."""
    return ProjectionMissing(
        f"{where}: the checkpoint of the {sink} has {found.next_offset:,} events, but their"
        f" tables were dropped; {replay_advice(log, settings)}"
    )
