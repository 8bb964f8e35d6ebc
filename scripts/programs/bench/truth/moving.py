"""Scores of moved things: of those that the robot could know to be moved, how many are reported."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from projections.localize.evaluate.scores import instances_of
from projections.localize.evaluate.truth import Truth
from projections.map.records import ObjectRecord
from projections.map.view import MapView

from .scoring import majorities
from .worlds import TrueThing


@dataclass(frozen=True, slots=True)
class MovedScores:
    """``knowable`` moved things: seen in the first run, and later either seen or their old spot in
    view. ``moved`` of them have an Object that was relocated, ``missing`` others one that is
    missing. ``others`` are the things that stand where they stood and were seen in the first run;
    ``wronged`` of them have an Object that is called moved or missing.

    ``phantoms`` are Objects of the first run without any true observation, ``gone`` those of them
    that are called missing, rightly.
    """

    knowable: int
    moved: int
    missing: int
    others: int
    wronged: int
    phantoms: int
    gone: int


def score_moved(
    view: MapView,
    truth: Truth,
    things: Mapping[str, TrueThing],
    first_run: str,
    looks_again: Mapping[str, int],
    least_seen: int = 1,
    least_looks: int = 1,
) -> MovedScores:
    """Score a view of the first run and the later ones.

    A thing counts that has ``least_seen`` observations in the first run and, where it is moved,
    ``least_looks`` observations or views of its old spot later.
    """
    before, after = _observations(view, truth, first_run)
    owners = majorities(view, truth)
    reports = {o: report for o, record in view.objects.items() if (report := _report(record))}
    told: dict[str, set[str]] = {}
    for ordinal, record in view.objects.items():
        if ordinal in owners and ordinal in reports and _is_of(view, record, first_run):
            told.setdefault(owners[ordinal], set()).add(reports[ordinal])
    known = [thing for thing in things.values() if before[thing.instance] >= least_seen]
    moved = [
        told.get(thing.instance, set())
        for thing in known
        if thing.moved_to is not None
        and max(after[thing.instance], looks_again.get(thing.instance, 0)) >= least_looks
    ]
    others = [told.get(thing.instance, set()) for thing in known if thing.moved_to is None]
    phantoms = [
        ordinal
        for ordinal, record in view.objects.items()
        if ordinal not in owners and _is_of(view, record, first_run)
    ]
    return MovedScores(
        len(moved),
        sum("moved" in reported for reported in moved),
        sum(reported == {"missing"} for reported in moved),
        len(others),
        sum(bool(reported) for reported in others),
        len(phantoms),
        sum(ordinal in reports for ordinal in phantoms),
    )


def _observations(view: MapView, truth: Truth, first_run: str) -> tuple[Counter[str], Counter[str]]:
    """How often each instance was seen in the first run, and later."""
    before, after = Counter[str](), Counter[str]()
    for observation, instance in instances_of(view, truth):
        if instance is not None:
            keyframe = view.keyframes[view.observations[observation].keyframe]
            (before if keyframe.run_id == first_run else after)[instance] += 1
    return before, after


def _report(record: ObjectRecord) -> str | None:
    """What the map says of an Object; None that it stands where it stood."""
    if record.missing_in is not None:
        return "missing"
    return "moved" if record.relocations else None


def _is_of(view: MapView, record: ObjectRecord, run_id: str) -> bool:
    """Whether an Object was seen in a run."""
    keyframes = (view.keyframes[view.observations[o].keyframe] for o in record.observations)
    return any(keyframe.run_id == run_id for keyframe in keyframes)
