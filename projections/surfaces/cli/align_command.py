"""``mapfold align``: runs that find each other by what both have seen."""

import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader
from projections.edit.correct_poses import Span, by_transform
from projections.edit.make import Stamp
from projections.edit.record import Made, record_command, recorded_document
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.store.history_recorder import map_after

from .edit_command import recorded_text
from .folded_log import CachedLog, OpenLog, settings_from
from .option import option
from .options import JsonOption, ZenohClient, check_picture, user_at_host
from .terminal import display, emit, finish, say

if TYPE_CHECKING:
    from projections.localize.align.alignment import Alignment

_NAMED = 5
"""Pairs that the reason of a command names."""
_EVERYWHERE = Span(None, None)


@dataclass(frozen=True, kw_only=True)
class _Frames(CachedLog):
    """The runs to move, and into which frame."""

    run: Annotated[
        str | None, option("RUN", "The run to move [default: the other one].", "--run")
    ] = None
    to: Annotated[
        str | None,
        option(
            "RUN|LOG",
            "The run, or the other log, whose frame it gets [default: the log's first run].",
            "--to",
        ),
    ] = None

    def maps(self, opened: OpenLog) -> tuple[MapView, MapView, str, list[RunId]]:
        """The map of the frame, the map to move, what the frame is called, the runs to move.
        Raises MisuseError for a run that the log does not have."""
        from projections.localize.align.framed_things import map_of_runs

        reader, end, _, corrections, settings = opened
        view = map_after(
            reader, settings, end, corrections=corrections, note=say, cache=not self.no_cache
        )
        runs = [run.run_id for run in view.runs]
        target = runs[0] if self.to is None and runs else self.to
        if target in runs:
            moved = [self._moved(runs, RunId(target))]
            others = set(runs) - {target}
            frame = map_of_runs(reader, end, corrections, settings, others)
        elif target is not None and Path(target).is_dir():
            moved = runs if self.run is None else [self._known(runs, self.run)]
            with LogReader(Path(target)) as other:
                known = read_corrections(other, other.next_offset)
                own = settings_from(None, None, known)
                frame = map_of_runs(other, other.next_offset, known, own, ())
        else:
            raise MisuseError(
                f"--to {visible(str(target))}: neither a run of {self.log} nor a log; {_runs(runs)}"
            )
        rest = set(runs) - set(moved)
        return frame, map_of_runs(reader, end, corrections, settings, rest), str(target), moved

    def _moved(self, runs: list[RunId], target: RunId) -> RunId:
        """The run that gets the frame of the run ``target``."""
        if self.run is not None:
            if self.run == target:
                raise MisuseError(f"--run and --to are both {visible(target)}; give two runs")
            return self._known(runs, self.run)
        others = [run for run in runs if run != target]
        if len(others) != 1:
            asked = _runs(others) if others else "it has no other runs"
            raise MisuseError(f"--run is missing: which run is to be moved? {asked}")
        return others[0]

    def _known(self, runs: list[RunId], run: str) -> RunId:
        if run not in runs:
            raise MisuseError(f"--run {visible(run)}: not in {self.log}; {_runs(runs)}")
        return RunId(run)


def _runs(runs: list[RunId]) -> str:
    named = ", ".join(map(visible, runs[:20]))
    return f"the runs are {named}" + (" …" if len(runs) > 20 else "") if runs else "it has no runs"


def align(
    *,
    frames: _Frames,
    write: Annotated[
        bool, typer.Option("--write", help="Record the correction of the run's poses.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --write: record also what is only likely.")
    ] = False,
    picture: Annotated[
        Path | None,
        option("FILE", "Draw both maps over each other: .png, .svg, .pdf.", "--picture"),
    ] = None,
    issued_by: Annotated[
        str | None, option("USER@HOST", "Who gives the command [default: your user@host].")
    ] = None,
    zenoh: ZenohClient,
    json_: JsonOption = False,
) -> None:
    """Find the rigid transform that brings a run into the frame of another, or of another log.

    Both runs are mapped alone, by evidence, and their objects compared by looks and distances. A
    transform is sure, likely, or not found: with few things in common right and wrong look alike.

    Exit 3 when none is found, or --write would need --yes.
    """
    check_picture(picture)
    try:
        from projections.localize.align.alignment import align as align_things
        from projections.localize.align.alignment import decision_text
        from projections.localize.align.framed_things import things_of_map
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold align needs {error.name}, which is not installed; pip install"
            " 'mapfold[align]'"
        ) from None
    with frames.opened() as opened:
        frame, moved, target, runs = frames.maps(opened)
    first, second = things_of_map(frame), things_of_map(moved)
    if first is None or second is None:
        bare = visible(target) if first is None else ", ".join(map(visible, runs))
        raise MapfoldError(
            f"{bare}: no object has both an embedding and a position, by which maps are compared"
        )
    found = align_things(first, second)
    title = f"{', '.join(map(visible, runs))} into the frame of {visible(target)}"
    if picture is not None and found is not None:
        from projections.adapters.drawing.merge_picture import draw_alignment

        draw_alignment(frame, moved, found, picture, title)
    is_usable = found is not None and found.verdict in ("sure", "likely" if yes else "sure")
    made = []
    if write and is_usable and found is not None and not found.is_one_frame:
        reason = f"aligned to {target}: {_evidence(frame, found)}"
        who = user_at_host() if issued_by is None else issued_by
        made = [
            _record(frames, zenoh, run, found, Stamp(uuid.uuid4().hex, who, reason)) for run in runs
        ]
    if json_:
        emit(_document(found, target, runs, made))
    else:
        display(f"{title}: {decision_text(found)}{_pair_lines(frame, found)}")
        for each in made:
            display(recorded_text(each))
        if found is not None and found.verdict != "unknown" and not made and not found.is_one_frame:
            also = " --yes" if found.verdict == "likely" else ""
            say(f"nothing is written; --write{also} records the correction of its poses")
    finish(findings=found is None or found.verdict == "unknown" or (write and not is_usable))


def _record(
    frames: _Frames, zenoh: ZenohClient, run: RunId, found: "Alignment", stamp: Stamp
) -> Made:
    return record_command(
        frames.log,
        lambda current, stamp: by_transform(current, stamp, run, _EVERYWHERE, *found.transform),
        stamp,
        frames.settings,
        zenoh.session,
        say,
    )


def _evidence(frame: MapView, found: "Alignment") -> str:
    """The best pairs, by the observations that founded the Objects, and the numbers."""
    best = sorted(found.pairs, key=lambda pair: -pair[2])[:_NAMED]
    classes = _classes(frame)
    named = ", ".join(f"{classes[one]} {one} = {other}" for one, other, _ in best)
    return (
        f"{counted(len(found.pairs), 'common thing')}, score {found.score:.0f}, next best"
        f" {found.second:.0f}, ± {found.se_m:.2f} m; {named}"
    )


def _pair_lines(frame: MapView, found: "Alignment | None") -> str:
    if found is None or found.verdict == "unknown":
        return ""
    classes = _classes(frame)
    best = sorted(found.pairs, key=lambda pair: -pair[2])
    lines = [f"  {visible(classes[one])}  {one} = {other}" for one, other, _ in best[:_NAMED]]
    more = len(best) - len(lines)
    return "\n" + "\n".join([*lines, f"  and {more:,} more"] if more else lines)


def _classes(frame: MapView) -> dict[str, str]:
    return {each.object_id: each.class_name for each in frame.objects.values()}


def _document(
    found: "Alignment | None", target: str, runs: list[RunId], made: list[Made]
) -> dict[str, Any]:
    result: dict[str, Any] = {"verdict": "unknown", "common": 0}
    if found is not None:
        result = found.document()
    return {"runs": runs, "to": target, **result, "recorded": [recorded_document(m) for m in made]}
