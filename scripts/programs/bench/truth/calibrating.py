"""Calibrated constants beside the priors: the table of ``scripts/bench_truth --calibrated``."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence

from eventsrc.envelope.ingest import Accepted
from projections.fold.settings import Settings
from projections.localize.calibrate.rounds import calibrate_by
from projections.map.view import MapView

from .folding import fold_into
from .scoring import ObjectScores
from .tables import HOUSE, Row, number

WORSE_V = 0.01
"""So much worse in V no calibrated map may be."""


def calibrated_settings(
    events: Sequence[Accepted], settings: Settings, *, ask: bool = False
) -> tuple[Settings, float]:
    """The settings with the constants that the map itself shows, those of re-localisation too if it
    is asked, and the processor time of it."""

    def fold(used: Settings) -> MapView:
        view = MapView(used)
        for _ in fold_into(view, events):
            pass
        return view

    start = time.process_time()
    return calibrate_by(fold, settings, ask=ask).calibrated, time.process_time() - start


_WIDTHS = (26, 7, 7, 7, 7, 7, 7, 7, 7, 7, 8)
_HEADS = (
    "profile world", "prior V", "cal V", "diff", "prior m", "cal m", "prior/t", "cal/t",
    "prior2σ", "cal 2σ", "cal s",
)  # fmt: skip


def calibration_table(rows: Sequence[Row]) -> str:
    """V, median position error, Objects for each thing and share within 2σ, with the priors and
    calibrated; processor time of the calibration. The line whose V lost most last, then means of
    each profile: + where V or position is better, ! where V is more than 0.01 worse."""
    present = [row for row in rows if row.calibrated is not None]
    ordered = sorted(present, key=lambda row: -(_of(row).v_measure - row.evidence.v_measure))
    lines = [_line(_HEADS)]
    lines += [_line(_cells(row.name, [row])) for row in ordered]
    buildings = [row for row in present if row.name != HOUSE]
    lines.append(_line(_cells("mean", buildings)))
    for profile in sorted({row.name.split()[0] for row in buildings}):
        own = [row for row in buildings if row.name.split()[0] == profile]
        lines.append(f"{_line(_cells(f'  {profile}', own))} {_verdict(own)}")
    return "\n".join(lines)


def _of(row: Row) -> ObjectScores:
    if row.calibrated is None:
        raise ValueError(f"{row.name} was not calibrated")
    return row.calibrated


def _cells(title: str, rows: Sequence[Row]) -> Iterator[str]:
    before, after = [row.evidence for row in rows], [_of(row) for row in rows]
    yield title
    values = [_mean(scores.v_measure for scores in each) for each in (before, after)]
    yield from (number(value, 3) for value in values)
    yield f"{values[1] - values[0]:+.3f}"
    yield from (number(_median_error(each), 3) for each in (before, after))
    yield from (number(_mean(scores.ratio for scores in each), 2) for each in (before, after))
    yield from (number(_inside(each), 2) for each in (before, after))
    yield number(sum(row.calibrated_s for row in rows), 1)


def _verdict(rows: Sequence[Row]) -> str:
    before, after = [row.evidence for row in rows], [_of(row) for row in rows]
    gained = _mean(s.v_measure for s in after) - _mean(s.v_measure for s in before)
    better = gained > 0.0 or _median_error(after) < _median_error(before)
    losses = [_of(row).v_measure - row.evidence.v_measure < -WORSE_V for row in rows]
    return ("+" if better else "-") + "!" * any(losses)


def _median_error(scores: Sequence[ObjectScores]) -> float:
    errors = sorted(error for each in scores for error in each.errors_m)
    return errors[len(errors) // 2] if errors else math.nan


def _inside(scores: Sequence[ObjectScores]) -> float:
    count = sum(len(each.errors_m) for each in scores)
    return sum(each.inside for each in scores) / count if count else math.nan


def _mean(values: Iterable[float]) -> float:
    present = [value for value in values if not math.isnan(value)]
    return sum(present) / len(present) if present else math.nan


def _line(cells: Iterable[str]) -> str:
    first, *rest = zip(cells, _WIDTHS, strict=True)
    return first[0].ljust(first[1]) + " ".join(cell.rjust(width) for cell, width in rest)
