"""Scores of what `mapfold diff` says between two runs: how many of its changes are true."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass

from projections.ask.object_changes import object_shift_m
from projections.history.diff import difference_of
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView

from .scoring import majorities
from .worlds import TrueThing

_TOLD_M = 0.005
"""From here on the rule before printed a shift."""


@dataclass(frozen=True, slots=True)
class ToldScores:
    """``sure`` moved and missing Objects; ``told`` are these and those that may be. ``shifted`` are
    those that the rule before called moved, by any shift of the estimate or another place. Each
    with how many are ``true``: the thing that the Object was in the first map stands elsewhere.
    ``knowable`` things were moved, and are in the first map."""

    sure: int
    sure_true: int
    told: int
    told_true: int
    shifted: int
    shifted_true: int
    knowable: int


def score_told(
    before: MapView, after: MapView, truth: Truth, things: Mapping[str, TrueThing]
) -> ToldScores:
    """Score the difference of the map of the first run and the map of both."""
    found = difference_of(before, after, {}, ())
    moved = {thing.instance for thing in things.values() if thing.moved_to is not None}
    owners = majorities(before, truth)
    of = {o.object_id: owners.get(number) for number, o in before.objects.items()}
    told = {each.before.object_id: each.sure for each in found.became.moved}
    told |= {each.before.object_id: each.sure for each in found.became.missing if not each.back}
    shifted = [
        old.object_id
        for old, new in found.objects.changed
        if object_shift_m(old, new) > _TOLD_M or old.place_id != new.place_id
    ]
    true = {name for name, instance in of.items() if instance in moved}
    sure = [name for name, is_sure in told.items() if is_sure]
    return ToldScores(
        len(sure),
        len(true.intersection(sure)),
        len(told),
        len(true.intersection(told)),
        len(shifted),
        len(true.intersection(shifted)),
        len(moved.intersection(Counter(of.values()))),
    )


_HEADS = ("true", "sure", "share", "true", "told", "share", "of", "true", "before", "share")


def told_table(rows: Iterable[tuple[str, ToldScores]]) -> str:
    """For each case: sure changes and how many are true, all told, moved things in the first map,
    and the rule before; the case with most false ones last."""
    both = sorted(rows, key=lambda row: (row[1].sure - row[1].sure_true, row[0]))
    lines = [_line("diff of runs a and b", _HEADS)]
    lines += [_line(name, _cells(scores)) for name, scores in both]
    sums = [sum(column) for column in zip(*(astuple(s) for _, s in both), strict=True)]
    return "\n".join([*lines, _line("all", _cells(ToldScores(*sums)))])


def _cells(scores: ToldScores) -> Sequence[str]:
    s = scores
    return (
        *(str(s.sure_true), str(s.sure), _share(s.sure_true, s.sure)),
        *(str(s.told_true), str(s.told), _share(s.told_true, s.told), str(s.knowable)),
        *(str(s.shifted_true), str(s.shifted), _share(s.shifted_true, s.shifted)),
    )


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.2f}" if whole else "-"


def _line(name: str, cells: Iterable[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(7) for cell in cells)
