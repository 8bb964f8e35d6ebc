"""Commands to run next, with the settings they need, for messages about a checkpoint."""

import json
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from projections.settings import Settings

_BY_PROGRAMS_ONLY = "neighbourhood"


def command(name: str, log: Path, settings: Settings, *options: str) -> str:
    """``mapfold NAME LOG`` with ``options`` and the ``--set`` for all that is not as by default."""
    default = Settings().model_dump()
    changed = [key for key, value in settings.model_dump().items() if value != default[key]]
    words = ["mapfold", name, shlex.quote(str(log)), *options, *_options(settings, changed)]
    return " ".join(words)


def remake(log: Path, settings: Settings) -> str:
    """What to do about a projection that does not fit the log or the settings."""
    return f"to make the map anew run: {command('replay', log, settings)}"


def differences(before: str, settings: Settings) -> list[str]:
    """What is another than in a checkpoint's settings: ``eps_m=0.75 there, 1.5 here``."""
    old, new = json.loads(before), json.loads(settings.model_dump_json())
    return [
        f"{name}={old.get(name)} there, {new.get(name)} here" for name in _different(old, new)
    ] or ["made by another version"]


def fitting(before: str, settings: Settings) -> str | None:
    """The ``--set`` options that make ``settings`` those of a checkpoint; None if none can."""
    try:
        old = Settings.model_validate_json(before)
    except ValidationError:
        return None
    changed = _different(old.model_dump(), settings.model_dump())
    if _BY_PROGRAMS_ONLY in changed:
        return None
    return " ".join(_options(old, changed)) or None


def _options(settings: Settings, names: Iterable[str]) -> list[str]:
    values = settings.model_dump()
    return [
        f"--set {shlex.quote(f'{name}={_said(values[name])}')}"
        for name in names
        if name != _BY_PROGRAMS_ONLY
    ]


def _said(value: object) -> str:
    return "none" if value is None else str(value)


def _different(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    return [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]
