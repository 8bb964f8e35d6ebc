"""`mapfold calibrate`: the constants of fusion by evidence, from the map's own revisits."""

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised, counted
from eventsrc.envelope.commands import Command
from eventsrc.log import LogReader
from projections.edit import make
from projections.edit.current import MapToEdit
from projections.edit.make import Stamp
from projections.edit.record import record_command, recorded_document
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.localize.calibrate.report import document, text
from projections.localize.calibrate.rounds import Calibration, calibrate
from projections.map.parsing import read_corrections

from .edit_command import keep_effect, recorded_text
from .folded_log import LogSettings
from .option import option
from .options import JsonOption, ZenohClient, user_at_host
from .terminal import Bar, display, emit, say


class _NothingNew(MapfoldError):
    """The log has these settings already."""


class _Calibrator:
    """Makes the command; the last of ``calibrations`` is the one that it was made from."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress = progress
        self.calibrations: list[Calibration] = []

    def __call__(self, current: MapToEdit, stamp: Stamp) -> Command:
        found = calibrate(
            current.reader, current.settings, current.corrections, current.end, self._progress
        )
        self.calibrations.append(found)
        if found.calibrated == (current.corrections.settings or Settings()):
            raise _NothingNew
        reason = stamp.reason or (
            f"calibrated: {counted(found.last.things, 'thing')} seen"
            f" {found.last.observations:,} times"
        )
        return make.use_settings(current, stamp._replace(reason=reason), found.calibrated)


def calibrate_command(
    *,
    write: Annotated[
        bool,
        typer.Option("--write", help="Record the constants in the log, as a use-settings command."),
    ] = False,
    all_: Annotated[bool, typer.Option("--all", help="Show the size of every class.")] = False,
    json_: JsonOption = False,
    source: LogSettings,
    reason: Annotated[
        str, option("TEXT", "With --write: why [default: what the calibration rests on].")
    ] = "",
    issued_by: Annotated[
        str | None,
        option("USER@HOST", "With --write: who gives the command [default: your user@host]."),
    ] = None,
    client: ZenohClient,
) -> None:
    """Estimate the constants of fusion by evidence from the map's own revisits.

    Things seen from several spots give usual distances, errors of boxes and poses, sizes of things,
    and the likeness of their pictures from other sides and on other days; pairs in one picture give
    the likeness of different things. Each constant is drawn towards its prior until some hundred
    observations support it.

    Then questions from the map's own keyframes, each asked with the observations around it left out
    of the map, give the errors of re-localisation and the correction of its two probabilities on
    this map.

    With --write every fold of the log uses them from then on, with the other settings in force and
    those of --set; `mapfold edit LOG undo` takes it back.
    """
    log, chosen = source.log, source.checked()
    if (reason or issued_by is not None) and not write:
        raise MisuseError("--reason and --issued-by are for --write")
    if not write:
        found = _calibrated(log, chosen)
        if json_:
            emit(document(found, log) | {"recorded": None})
        else:
            display(text(found, log, all_=all_))
        if found.field is not None:
            say(f"`{advised('calibrate', log, '--write')}` records the camera and the constants")
        return
    stamp = Stamp(uuid.uuid4().hex, user_at_host() if issued_by is None else issued_by, reason)
    with Bar() as bar:
        calibrator = _Calibrator(bar.show_fold)
        try:
            made = record_command(log, calibrator, stamp, chosen, client.session, say)
        except _NothingNew:
            made = None
    found = calibrator.calibrations[-1]
    if made is not None:
        keep_effect(made)
    if json_:
        recorded = None if made is None else recorded_document(made)
        emit(document(found, log) | {"recorded": recorded})
    else:
        last = (
            "the log has these constants already; nothing is recorded"
            if made is None
            else recorded_text(made)
        )
        display(text(found, log, all_=all_) + last)


def _calibrated(log: Path, chosen: Callable[[Corrections], Settings]) -> Calibration:
    with LogReader(log) as reader, Bar() as bar:
        corrections = read_corrections(reader)
        return calibrate(reader, chosen(corrections), corrections, progress=bar.show_fold)
