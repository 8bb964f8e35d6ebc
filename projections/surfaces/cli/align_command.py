"""``mapfold align``: runs that find each other by what both have seen."""

import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.progress import reported
from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader
from projections.edit.correct_poses import Span, by_alignment, frames_of_runs
from projections.edit.make import Stamp
from projections.edit.record import Made, record_command, recorded_document
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.store.history_recorder import map_after

from .edit_command import recorded_text
from .folded_log import CachedLog, OpenLog, settings_from
from .options import JsonOption, ZenohClient, check_picture, option, user_at_host
from .terminal import display, emit, finish, say

if TYPE_CHECKING:
    from projections.localize.align.alignment import Alignment
    from projections.localize.align.jumps import LargeStep
    from projections.localize.align.several import Contradiction

_NAMED = 5
"""Pairs that the reason of a command names."""
_SEVERAL = 3
"""Runs of a log that are all aligned, where none is named."""
_EVERYWHERE = Span(None, None)
_TWO_NAMES = ", under two names, which --write joins"
_NO_JUMP = "no step in a run of 20 keyframes or more is larger than usual: no frame jumped"


@dataclass(frozen=True, slots=True)
class _Proposal:
    """What was found for keyframes of some runs: a transform to record, for a ``reason``, or
    none."""

    runs: list[RunId]
    span: Span
    verdict: str
    transform: tuple[float, float, float] | None
    text: str
    reason: str
    document: dict[str, Any]


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

    def pair(self, picture: Path | None) -> _Proposal:
        """A run in the frame of another, or all of them in that of another log. Raises MisuseError
        for a run that the log does not have."""
        from projections.localize.align.alignment import align as align_things
        from projections.localize.align.alignment import decision_text
        from projections.localize.align.framed_things import things_of_map

        with self.opened() as opened:
            frame, moved, target, runs = self._maps(opened)
            there = self._of_runs(opened)
        first, second = things_of_map(frame), things_of_map(moved)
        if first is None or second is None:
            bare = visible(target) if first is None else ", ".join(map(visible, runs))
            raise MapfoldError(
                f"{bare}: no object has both an embedding and a position, by which maps are"
                " compared"
            )
        found = align_things(first, second)
        title = f"{', '.join(map(visible, runs))} into the frame of {visible(target)}"
        if picture is not None and found is not None:
            from projections.adapters.drawing.merge_picture import draw_alignment

            draw_alignment(frame, moved, found, picture, title)
            say(f"both maps are in {picture}")
        is_apart = any(there.get(run) != there.get(RunId(target), there.get(run)) for run in runs)
        is_to_move = found is not None and (is_apart or not found.is_one_frame)
        text = f"{title}: {decision_text(found)}"
        text += _TWO_NAMES if is_apart and found is not None and found.is_one_frame else ""
        text += _pair_lines(found)
        about = {"runs": runs, "to": target}
        reason = f"aligned to {target}"
        return _proposed(runs, _EVERYWHERE, found, is_to_move, text, reason, about)

    def jumps(self) -> list[_Proposal]:
        """What is behind the large steps of the runs."""
        from projections.localize.align.jumps import jumps_of_run

        with self.opened() as opened:
            reader, end, _, corrections, settings = opened
            view = self._view(opened)
            runs = [run.run_id for run in view.runs]
            chosen = runs if self.run is None else [self._known(runs, self.run)]
            return [
                _of_step(run, step)
                for run in reported(chosen, "looking for jumps", len(chosen), "runs")
                for step in jumps_of_run(reader, end, corrections, settings, view, run)
            ]

    def all_runs(self) -> tuple[list[_Proposal], list["Contradiction"]] | None:
        """Every run in the frame of the first that it can be joined with, and the pairs that
        contradict the others; None for a log of less than three runs."""
        from projections.localize.align.framed_things import maps_of_runs, things_of_map
        from projections.localize.align.several import align_runs

        with self.opened() as opened:
            reader, end, _, corrections, settings = opened
            runs = [run.run_id for run in self._view(opened).runs]
            if len(runs) < _SEVERAL:
                return None
            maps, there = (
                maps_of_runs(reader, end, corrections, settings, runs),
                self._of_runs(opened),
            )
        made = {run: things_of_map(each) for run, each in maps.items()}
        placed, against = align_runs({run: each for run, each in made.items() if each is not None})
        apart = {each.run for each in placed if there.get(each.run) != there.get(each.frame)}
        proposals = [
            _Proposal(
                [each.run],
                _EVERYWHERE,
                each.verdict,
                each.transform
                if each.verdict != "unknown" and (each.run in apart or not each.is_one_frame)
                else None,
                f"{each}{_TWO_NAMES}" if each.run in apart and each.is_one_frame else str(each),
                f"aligned to {each.frame} by {counted(each.pairs, 'pair')} of runs",
                each.document(),
            )
            for each in placed
        ]
        joined = {each.run for each in placed} | {each.frame for each in placed}
        proposals += [
            _Proposal(
                [run],
                _EVERYWHERE,
                "unknown",
                None,
                f"{visible(run)}: cannot tell: too little in common with every other run",
                "",
                {"run": run, "verdict": "unknown"},
            )
            for run in runs
            if run not in joined
        ]
        return proposals, against

    def of_runs(self) -> dict[RunId, set[str | None]]:
        """The frames that each run is in; see `frames_of_runs`."""
        with self.opened() as opened:
            return self._of_runs(opened)

    def _of_runs(self, opened: OpenLog) -> dict[RunId, set[str | None]]:
        return frames_of_runs(opened[0], self._view(opened))

    def _view(self, opened: OpenLog) -> MapView:
        reader, end, _, corrections, settings = opened
        return map_after(
            reader, settings, end, corrections=corrections, note=say, cache=not self.no_cache
        )

    def _maps(self, opened: OpenLog) -> tuple[MapView, MapView, str, list[RunId]]:
        """The map of the frame, the map to move, what the frame is called, the runs to move.
        Raises MisuseError for a run that the log does not have."""
        from projections.localize.align.framed_things import map_of_runs, own_map

        reader, end, _, corrections, settings = opened
        runs = [run.run_id for run in self._view(opened).runs]
        if not runs:
            raise MisuseError(f"{self.log} has no run that could be aligned")
        target = runs[0] if self.to is None else self.to
        if target in runs:
            moved = [self._moved(runs, RunId(target))]
            others = set(runs) - {target}
            frame = map_of_runs(reader, end, corrections, settings, others)
        elif Path(target).is_dir():
            moved = runs if self.run is None else [self._known(runs, self.run)]
            with LogReader(Path(target)) as other:
                known = read_corrections(other, other.next_offset)
                own = settings_from(None, None, known)
                frame = own_map(other, other.next_offset, known, own)
        else:
            raise MisuseError(
                f"--to {visible(target)}: neither a run of {self.log} nor a log; {_runs(runs)}"
            )
        rest = set(runs) - set(moved)
        return frame, map_of_runs(reader, end, corrections, settings, rest), target, moved

    def _moved(self, runs: list[RunId], target: RunId) -> RunId:
        """The run that gets the frame of the run ``target``."""
        if self.run is not None:
            if self.run == target:
                raise MisuseError(f"--run and --to are both {visible(target)}; give two runs")
            return self._known(runs, self.run)
        others = [run for run in runs if run != target]
        if not others:
            raise MisuseError(
                f"{self.log} has one run, {visible(target)}: import another one into it, or name"
                " another log by --to"
            )
        if len(others) > 1:
            raise MisuseError(f"--run is missing: which run is to be moved? {_runs(others)}")
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
    jumps: Annotated[
        bool,
        typer.Option(
            "--jumps", help="Find where a run's frame jumped: localisation was lost and set wrong."
        ),
    ] = False,
    write: Annotated[
        bool, typer.Option("--write", help="Record the correction of the poses.")
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

    Without --run and --to all runs of a log are aligned, by every pair of them. Each run is mapped
    alone, by evidence, and objects are compared by looks and distances. A transform is sure,
    likely, or not found: with few things in common right and wrong look alike.

    Exit 3 when one cannot be told or --write would need --yes; with --jumps also when one is left.
    """
    check_picture(picture)
    if jumps and (picture is not None or frames.to is not None):
        raise MisuseError("--jumps takes neither --to nor --picture: a jump is within a run")
    try:
        several = None if jumps or frames.run or frames.to or picture else frames.all_runs()
        if several is not None:
            proposals = several[0]
        else:
            proposals = frames.jumps() if jumps else [frames.pair(picture)]
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold align needs {error.name}, which is not installed; pip install"
            " 'mapfold[align]'"
        ) from None
    if not json_:
        contradictions = map(str, several[1]) if several is not None else ()
        lines = [*(each.text for each in proposals), *contradictions]
        display("\n".join(lines) or _NO_JUMP)
    who = user_at_host() if issued_by is None else issued_by
    wanted = ("sure", "likely" if yes else "sure")
    recorded, left = list[dict[str, Any]](), [each for each in proposals if each.transform]
    if write:
        usable = [each for each in left if each.verdict in wanted]
        left = [each for each in left if each.verdict not in wanted]
        there, joined = frames.of_runs(), set[str | None]()
        for proposal, run in ((each, run) for each in usable for run in each.runs):
            if there.get(run, set()) & joined:
                say(f"{visible(run)}: moved with its frame, which is joined already")
                continue
            made = _record(frames, zenoh, run, proposal, who)
            if made.command.kind == "join-frames":
                joined.add(made.command.frame)
            recorded.append(recorded_document(made))
            if not json_:
                display(recorded_text(made))
    documents = [each.document for each in proposals]
    if json_ and several is not None:
        against = [each._asdict() for each in several[1]]
        emit({"runs": documents, "contradictions": against, "recorded": recorded})
    elif json_:
        emit(({"steps": documents} if jumps else documents[0]) | {"recorded": recorded})
    elif left:
        also = " --yes" if all(each.verdict == "likely" for each in left) else ""
        what = "what is not sure is not" if recorded else "nothing is"
        say(f"{what} recorded; --write{also} records the correction of its poses")
    is_unknown = any(each.verdict == "unknown" for each in proposals)
    finish(findings=is_unknown or (bool(left) and (write or jumps)))


def _proposed(
    runs: list[RunId],
    span: Span,
    found: "Alignment | None",
    is_to_move: bool,
    text: str,
    reason: str,
    about: dict[str, Any],
) -> _Proposal:
    numbers: dict[str, Any] = {"verdict": "unknown", "common": 0}
    if found is None or found.verdict == "unknown":
        document = about | (numbers if found is None else found.document())
        return _Proposal(runs, span, "unknown", None, text, "", document)
    transform = found.transform if is_to_move else None
    reason = f"{reason}: {_evidence(found)}"
    document = about | found.document()
    return _Proposal(runs, span, found.verdict, transform, text, reason, document)


def _of_step(run: RunId, step: "LargeStep") -> _Proposal:
    """A large step of a run, and whether a jump of the frame explains it."""
    from projections.localize.align.alignment import decision_text

    first, last = step.stretch
    to = "the end" if last is None else str(last)
    title = f"{visible(run)}: a step of {step.step_m:.1f} m to keyframe {first}; from there to {to}"
    found = step.found
    is_told = found is not None and found.verdict != "unknown"
    text = f"{title} {decision_text(found)}"
    if is_told and not step.is_jump:
        text = f"{title} no other frame explains it"
    elif step.is_jump:
        text += _pair_lines(found)
    about = {"run": run, "first": first, "last": last, "step_m": step.step_m}
    about["jumped"] = step.is_jump
    span = Span(first, last)
    return _proposed([run], span, found, step.is_jump, text, "its frame jumped", about)


def _record(frames: _Frames, zenoh: ZenohClient, run: RunId, proposal: _Proposal, who: str) -> Made:
    dx, dy, dyaw = proposal.transform or (0.0, 0.0, 0.0)
    to: str | None = proposal.document.get("to")
    return record_command(
        frames.log,
        lambda current, stamp: by_alignment(current, stamp, run, to, proposal.span, dx, dy, dyaw),
        Stamp(uuid.uuid4().hex, who, proposal.reason),
        frames.settings,
        zenoh.session,
        say,
    )


def _evidence(found: "Alignment") -> str:
    """The best pairs, by the observations that founded the Objects, and the numbers."""
    return (
        f"{counted(len(found.pairs), 'common thing')}, score {found.score:.0f}, next best"
        f" {found.second:.0f}, ± {found.se_m:.2f} m; {', '.join(found.best_pairs(_NAMED))}"
    )


def _pair_lines(found: "Alignment | None") -> str:
    if found is None or found.verdict == "unknown":
        return ""
    best, more = found.best_pairs(_NAMED), len(found.pairs) - _NAMED
    lines = [f"\n  {line}" for line in best]
    return "".join([*lines, f"\n  and {more:,} more"] if more > 0 else lines)
