"""`mapfold calibrate`: the constants of fusion by evidence, from the map's own revisits, and the
scores of re-localisation on the map's own questions, as text and as JSON."""

import uuid
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised, command_line, counted, table, visible
from eventsrc.envelope.commands import Command
from eventsrc.log import LogReader
from projections.edit import make
from projections.edit.current import MapToEdit
from projections.edit.make import Stamp
from projections.edit.record import record_command, recorded_document
from projections.fold.settings import Settings
from projections.localize.calibrate.field_of_view import (
    LEAST_OBSERVATIONS,
    LEAST_THINGS,
    FieldOfView,
)
from projections.localize.calibrate.likenesses import FEWEST_DIFFERENT
from projections.localize.calibrate.localiser import CROPS, OwnScores
from projections.localize.calibrate.readings import Reading
from projections.localize.calibrate.rounds import Calibration, calibrate
from projections.localize.evaluate.own_questions import own_scores
from projections.localize.relocalize import UNKNOWN_BELOW
from projections.map.parsing import read_corrections
from projections.map.state_output import state_camera

from .edit_command import keep_effect, recorded_text
from .folded_log import LogSettings
from .options import JsonOption, ZenohClient, option, user_at_host
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
        with LogReader(log) as reader, Bar() as bar:
            known = read_corrections(reader)
            found = calibrate(reader, chosen(known), known, progress=bar.show_fold)
        if json_:
            emit(_document(found, log) | {"recorded": None})
        else:
            display(_text(found, log, all_=all_))
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
        emit(_document(found, log) | {"recorded": recorded})
    else:
        last = (
            "the log has these constants already; nothing is recorded"
            if made is None
            else recorded_text(made)
        )
        display(_text(found, log, all_=all_) + last)


_MOST_SIZES = 8
_RESTS_ON = {
    "bearing_rad": "observation",
    "bearing_cut_rad": "cut observation",
    "size_spread": "thing",
    "different": "pair",
    "different_spread": "pair",
    "same_class": "pair",
    "same_class_spread": "pair",
    "session_shift": "observation",
}
_SIZE = "sizes_m."
_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0)
_DECIMALS = 6
FEW = 20
"""The number of known questions below which the figures are unreliable."""


def _document(calibration: Calibration, log: Path) -> dict[str, Any]:
    """JSON. ``name`` is what ``--set`` takes."""
    last = calibration.last
    return {
        "keyframes": calibration.keyframes,
        "observations": calibration.observations,
        "objects": calibration.objects,
        "runs": calibration.runs,
        "things": last.things,
        "observations_of_things": last.observations,
        "fusion": calibration.settings.fusion,
        "constants": [
            {
                "name": f"evidence.{each.name}",
                "value": each.value,
                "prior": each.prior,
                "seen": each.seen,
                "count": each.count,
            }
            for each in [*last.readings, *last.sizes]
        ],
        "camera": _camera_document(calibration.field),
        "localiser": localiser_document(calibration.own),
        "hints": list(_hints(calibration, log)),
    }


def _text(calibration: Calibration, log: Path, *, all_: bool = False) -> str:
    """A line on what it rests on, a table of the constants, and the hints."""
    last = calibration.last
    rests_on = (
        f"{counted(calibration.keyframes, 'keyframe')} with a pose, "
        f"{counted(calibration.observations, 'observation')} of "
        f"{counted(calibration.objects, 'object')} in {counted(calibration.runs, 'run')}; "
        f"{counted(last.things, 'thing')} with bearings that cross well, seen "
        f"{last.observations:,} times"
    )
    rows = [_row(each) for each in last.readings]
    sizes = sorted(last.sizes, key=lambda each: (-each.count, each.name))
    shown = sizes if all_ else sizes[:_MOST_SIZES]
    rows += [_row(each) for each in shown]
    lines = [rests_on]
    lines += table(
        ("evidence.", "value", "prior", "this map", "rests on"),
        rows,
        right=("value", "prior", "this map"),
    ).splitlines()
    if len(shown) < len(sizes):
        lines.append(f"… and the sizes of {len(sizes) - len(shown):,} more (--all shows them)")
    lines += _camera_lines(calibration)
    lines += localiser_text(calibration.own).splitlines()
    return "".join(f"{line}\n" for line in [*lines, *_hints(calibration, log)])


def _camera_lines(calibration: Calibration) -> list[str]:
    """The camera that nothing states, as estimated, in a line; none where it is stated."""
    found = calibration.field
    if found is None:
        return []
    camera, error = found.settings.constants, found.settings.hfov_error_deg
    size_by = "the extent of the boxes" if found.measured_px else "stated"
    line = (
        f"camera of {counted(calibration.unstated, 'keyframe')}, which nothing states: field of"
        f" view {camera.hfov_deg:g}° ± {error:g}° (the map alone says {found.seen_deg:g}° ±"
        f" {found.seen_error_deg:g}°) by {found.observations:,} bearings of"
        f" {counted(found.things, 'thing')}; pictures of {camera.width_px:g} ×"
        f" {camera.height_px:g} pixels, {size_by}"
    )
    return [line]


def _camera_document(found: FieldOfView | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        **found.settings.model_dump(),
        "seen_deg": found.seen_deg,
        "seen_error_deg": found.seen_error_deg,
        "size_from": "boxes" if found.measured_px else "settings",
        "things": found.things,
        "observations": found.observations,
    }


def _row(reading: Reading) -> tuple[str, ...]:
    is_size = reading.name.startswith(_SIZE)
    rests_on = "whole box" if is_size else _RESTS_ON.get(reading.name, "observation")
    if reading.count != 1:
        rests_on += "es" if rests_on.endswith("x") else "s"
    numbers = map(_number, (reading.value, reading.prior, reading.seen))
    return (
        visible(reading.name),
        *numbers,
        f"{reading.count:,} {rests_on}",
    )


def _number(value: float | str | None) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:g}"


def _hints(calibration: Calibration, log: Path) -> Iterator[str]:
    """Obstacles to a better calibration of a log, with the next step where there is one."""
    last, camera = calibration.last, calibration.calibrated.camera.constants
    if not calibration.observations:
        yield "no observation with a pose is of an object: all constants are priors"
        return
    if not calibration.embedded:
        yield "no observation has an embedding: the constants of likeness are left as they are"
    if calibration.unboxed:
        yield (
            f"{counted(calibration.unboxed, 'observation')} with an empty box: nothing is known of"
            " their direction"
        )
    if not last.things:
        yield (
            "nothing was seen three times from spots 0.8 m apart with bearings that cross: ranges,"
            " errors, sizes and the likeness of one thing are priors"
        )
    elif calibration.embedded and calibration.runs == 1:
        yield "one run: session_shift, the loss of likeness between runs, is a prior"
    pairs = next(each.count for each in last.readings if each.name == "different")
    if calibration.embedded and pairs < FEWEST_DIFFERENT:
        yield (
            f"{counted(pairs, 'pair')} of different classes in one picture, fewer than"
            f" {FEWEST_DIFFERENT}: `different` stays unset, so the fold measures it on the pictures"
        )
    if calibration.beyond:
        boxes = f"{calibration.beyond:,} box{'' if calibration.beyond == 1 else 'es'}"
        yield (
            f"{boxes} beyond the picture of {camera.width_px:g} × {camera.height_px:g} pixels: give"
            " the camera, --set camera.width_px=… --set camera.height_px=… --set camera.hfov_deg=…"
        )
    if calibration.unstated and calibration.field is None:
        yield (
            f"no camera is stated for {counted(calibration.unstated, 'keyframe')}, and fewer than"
            f" {LEAST_THINGS} things were seen {LEAST_OBSERVATIONS} times whole, too few to"
            f" estimate its field of view, now taken for {camera.hfov_deg:g}°:"
            f" `{visible(state_camera(log))}` states it"
        )
    for fault in last.camera:
        yield _camera_hint(fault, camera.hfov_deg)
    if calibration.settings.fusion != "evidence":
        full = command_line("edit", log, "use-settings", "--preset", "full", "--reason", "WHY")
        yield (
            "the map is folded with fusion=page, so its objects do not depend on these, only"
            f" re-localisation does; `{visible(full)}` makes places rooms and fuses objects by"
            " evidence"
        )


def _camera_hint(fault: Reading, hfov_deg: float) -> str:
    value = fault.value if isinstance(fault.value, float) else 0.0
    if fault.name == "yaw_rad":
        return (
            f"bearings are off by {value:+.3g} rad on the whole: the camera may be turned; compare"
            " camera.yaw_rad"
        )
    which = "too wide" if value > 0 else "too narrow"
    return (
        f"bearings are off by {abs(value):.0%} of the angle from the picture's middle: "
        f"camera.hfov_deg={hfov_deg:g} seems {which}"
    )


def localiser_document(own: OwnScores) -> dict[str, Any]:
    """JSON: scores on the map's own questions with the correction, by number of crops, and the
    correction as it is set.

    Scores have six decimals; beyond, machines may differ in the errors and in `confidence`.
    """
    constants = own.constants.model_dump(exclude={"text_shift"})
    return {
        "questions": {str(crops): _rounded(_scores(own, crops)) for crops in CROPS},
        "constants": {f"localizer.{name}": value for name, value in constants.items()},
    }


def localiser_text(own: OwnScores) -> str:
    """Two tables: errors and shares, and the share of right answers by stated probability."""
    if not own.answers:
        return "re-localisation: no keyframe to ask from\n"
    rows = [
        (
            counted(crops, "crop"),
            str(scores["questions"] // 2),
            str(scores["known"]),
            _two_decimals(scores["pose_error_m"]["p50"]),
            _two_decimals(scores["pose_error_m"]["p90"]),
            _two_decimals(scores["plain"]["pose_error_m"]["p50"]),
            _two_decimals(scores["within_1_5_m"]),
            _two_decimals(scores["known_called_unknown"]),
            _two_decimals(scores["taken_out_called_known"]),
        )
        for crops in CROPS
        if (scores := _scores(own, crops))["questions"]
    ]
    header = (
        "re-localisation", "asked", "known", "p50 m", "p90 m", "plain p50", "within 1.5 m",
        "called unknown", "taken out, called known",
    )  # fmt: skip
    bins = [f"said {low:g} to {high:g}" for low, high in pairwise(_EDGES)]
    known = ("known", *_right([(own.known(a), a.known) for a in own.answers]))
    sure = ("confidence", *_right([(own.confidence(a), a.correct) for a in own.answers]))
    tables = table(header, rows, right=header[1:])
    tables += table(("right, of how many", *bins), [known, sure], right=bins)
    count = sum(answer.known for answer in own.answers)
    if count < FEW:
        seen = "question" if count == 1 else "questions"
        tables += (
            f"{count} {seen} about what was seen at another time: too few for reliable figures, so"
            " re-localisation is hardly corrected\n"
        )
    return tables


def _scores(own: OwnScores, crops: int) -> dict[str, Any]:
    answers = [each for each in own.answers if each.crops == crops]
    return own_scores(answers, own.known, own.confidence, UNKNOWN_BELOW)


def _rounded(value: Any) -> Any:
    """A JSON value, its numbers rounded to `_DECIMALS`."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return round(value, _DECIMALS) if isinstance(value, float) else value


def _right(said: Sequence[tuple[float, bool]]) -> list[str]:
    """For each bin the share of right answers, and their number."""
    cells = []
    for low, high in pairwise(_EDGES):
        right = [each for p, each in said if low <= p < high or p == high == 1.0]
        cells.append(f"{sum(right) / len(right):.2f} of {len(right)}" if right else "-")
    return cells


def _two_decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
