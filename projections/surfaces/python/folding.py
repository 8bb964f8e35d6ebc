"""`open_log` and `fold`: from a folder of MCAP segments to a `Map`."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TypeAlias

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from projections.fold.corrections import Corrections
from projections.fold.errors import SettingsError
from projections.fold.settings import Settings, read_settings
from projections.map.fold import fold_log
from projections.map.own_events import read_corrections

from .map import Map

LogLike: TypeAlias = str | Path | LogReader
SettingsLike: TypeAlias = Settings | Mapping[str, Any] | str | Path | None


def open_log(path: str | Path) -> LogReader:
    """Open a log for reading; a context manager.

    Its events come from ``read(start, end)``, their number is ``next_offset``. A log that is being
    recorded may be opened; ``refresh()`` finds what was recorded since. Raises LogNotFound,
    NotALog or LogDamaged.

    Examples:
        >>> with open_log("logs/sample") as log:
        ...     log.next_offset, next(log.read()).key
        (445, 'tb/detections')
    """
    return LogReader(Path(path))


def fold(
    log: LogLike,
    *,
    at: int | str = "end",
    settings: SettingsLike = None,
    known_at: int | str | None = None,
    embeddings: bool = True,
) -> Map:
    """Fold a log into its map.

    ``at`` is the point up to which it is folded: a number of events, a time in ISO 8601,
    ``RUN:KEYFRAME`` or ``end``. ``settings`` are `Settings`, a mapping of their names as in
    ``--settings``, or a file of these; by default those that the log names. Commands recorded
    before ``known_at``, by default ``at``, are obeyed. Without ``embeddings`` the map takes less
    memory and cannot be asked by `relocalize`.

    Raises LogNotFound, NotALog or LogDamaged for the log, MisuseError for a point that it does not
    have, SettingsError for settings, FoldError for an event that cannot be folded.

    Examples:
        >>> fold("logs/sample", at=240)
        <Map after 240 events: 1 place, 54 objects, digest 9ef53eb412a130df>
    """
    with nullcontext(log) if isinstance(log, LogReader) else open_log(log) as reader:
        end = resolve(reader, str(at))
        known = end if known_at is None else resolve(reader, str(known_at))
        corrections = read_corrections(reader, known)
        chosen = settings_from(settings)(corrections)
        view = fold_log(reader, chosen, end, keep_embeddings=embeddings, corrections=corrections)[1]
    return Map(view, known)


def settings_from(settings: SettingsLike) -> Callable[[Corrections], Settings]:
    """The settings under some corrections: those given, else those that the log names."""
    if settings is None:
        return lambda corrections: corrections.settings or Settings()
    chosen = settings if isinstance(settings, Settings) else _parse(settings)
    return lambda _: chosen


def _parse(settings: Mapping[str, Any] | str | Path) -> Settings:
    if isinstance(settings, Mapping):
        return Settings.from_document(dict(settings))
    try:
        return read_settings(Path(settings))
    except FileFault as fault:
        raise MisuseError(f"settings {settings}: {fault}; give a file of JSON") from None
    except SettingsError as error:
        raise SettingsError(f"settings {settings}: {error}") from None
