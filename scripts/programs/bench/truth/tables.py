"""The tables of ``scripts/bench_truth``: the worst line last, then means over the buildings."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from .moving import MovedScores
from .scoring import ObjectScores
from .telling import ToldScores

HOUSE = "house-a"


@dataclass(frozen=True, slots=True)
class Row:
    """The scores of one case; ``well`` is `moved` over things that were seen well, ``calibrated``
    `evidence` with the constants of the map itself."""

    name: str
    keyframes: int
    page: ObjectScores
    evidence: ObjectScores
    page_s: float
    evidence_s: float
    moved: MovedScores | None = None
    well: MovedScores | None = None
    calibrated: ObjectScores | None = None
    calibrated_s: float = 0.0
    told: ToldScores | None = None


_HEADS = (
    ("profile world", 26),
    ("kf", 5),
    ("things", 7),
    ("page", 6),
    ("evid", 5),
    ("page/t", 7),
    ("evid/t", 7),
    ("page V", 7),
    ("evid V", 7),
    ("page R", 7),
    ("evid R", 7),
    ("p50 m", 6),
    ("in 2σ", 6),
    ("page s", 7),
    ("× evid", 7),
)


def objects_table(rows: Sequence[Row]) -> str:
    """Things and Objects seen twice or more, their ratio, V and adjusted Rand of observations,
    median position error and share within 2σ for things seen from two spots, processor time."""
    ordered = sorted(rows, key=lambda row: -row.evidence.v_measure)
    lines = [_line(head for head, _ in _HEADS)]
    lines += [_line(_cells(row)) for row in ordered]
    buildings = [row for row in rows if row.name != HOUSE]
    if len(buildings) > 1:
        lines += [_line(_mean_cells("mean", buildings))]
        for profile in sorted({row.name.split()[0] for row in buildings}):
            own = [row for row in buildings if row.name.split()[0] == profile]
            if len(own) not in (1, len(buildings)):
                lines.append(_line(_mean_cells(f"  {profile}", own)))
    return "\n".join(lines)


def _cells(row: Row) -> Iterable[str]:
    page, evidence = row.page, row.evidence
    return (
        row.name,
        str(row.keyframes),
        str(page.instances),
        str(page.objects),
        str(evidence.objects),
        number(page.ratio, 2),
        number(evidence.ratio, 2),
        number(page.v_measure, 3),
        number(evidence.v_measure, 3),
        number(page.adjusted_rand, 3),
        number(evidence.adjusted_rand, 3),
        number(evidence.median_error_m, 2),
        number(evidence.inside_share, 2),
        number(row.page_s, 2),
        number(_quotient(row.evidence_s, row.page_s), 2),
    )


def _mean_cells(title: str, rows: Sequence[Row]) -> Iterable[str]:
    """Means of the lines, but the median error and the share within 2σ over all Objects."""
    pages, evidences = [row.page for row in rows], [row.evidence for row in rows]
    errors = sorted(error for scores in evidences for error in scores.errors_m)
    page_s, evidence_s = sum(row.page_s for row in rows), sum(row.evidence_s for row in rows)
    return (
        title,
        str(sum(row.keyframes for row in rows)),
        str(sum(scores.instances for scores in pages)),
        str(sum(scores.objects for scores in pages)),
        str(sum(scores.objects for scores in evidences)),
        *(
            mean_of(scores, field, digits)
            for field, digits in (("ratio", 2), ("v_measure", 3), ("adjusted_rand", 3))
            for scores in (pages, evidences)
        ),
        number(errors[len(errors) // 2] if errors else math.nan, 2),
        number(_quotient(sum(scores.inside for scores in evidences), len(errors)), 2),
        number(page_s, 2),
        number(_quotient(evidence_s, page_s), 2),
    )


def moved_table(rows: Sequence[Row]) -> str:
    """Moved things reported, and others wrongly reported; the line with the smallest share last."""
    both = [(row.name, row.moved, row.well) for row in rows if row.moved and row.well]
    ordered = sorted(both, key=lambda line: -_quotient(_told(line[1]), line[1].knowable))
    heads = ("moved", "missing", "of", "share", "others", "of", "share", "well", "share", "ph.")
    lines = [_moved_line("profile world", heads)]
    lines += [_moved_line(name, _moved_cells(scores, well)) for name, scores, well in ordered]
    total = [_sum(scores for _, scores, _ in both), _sum(well for _, _, well in both)]
    return "\n".join([*lines, _moved_line("all", _moved_cells(*total))])


def _moved_cells(scores: MovedScores, well: MovedScores) -> Iterable[str]:
    return (
        str(scores.moved),
        str(scores.missing),
        str(scores.knowable),
        number(_quotient(_told(scores), scores.knowable), 2),
        str(scores.wronged),
        str(scores.others),
        number(_quotient(scores.wronged, scores.others), 3),
        str(well.knowable),
        number(_quotient(_told(well), well.knowable), 2),
        f"{scores.gone}/{scores.phantoms}",
    )


def _told(scores: MovedScores) -> int:
    return scores.moved + scores.missing


def _sum(scores: Iterable[MovedScores]) -> MovedScores:
    columns = zip(*map(_values, scores), strict=True)
    return MovedScores(*map(sum, columns))


def _values(scores: MovedScores) -> tuple[int, ...]:
    s = scores
    return s.knowable, s.moved, s.missing, s.others, s.wronged, s.phantoms, s.gone


def _line(cells: Iterable[str]) -> str:
    widths = (width for _, width in _HEADS)
    first, *rest = zip(cells, widths, strict=True)
    return first[0].ljust(first[1]) + " ".join(cell.rjust(width) for cell, width in rest)


def _moved_line(name: str, cells: Iterable[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(7) for cell in cells)


def mean_of(scores: Iterable[object], field: str, digits: int) -> str:
    """The mean of a field of those scores that have a number there; - where none has."""
    found = (getattr(each, field) for each in scores)
    present = [value for value in found if value is not None and not math.isnan(value)]
    return number(sum(present) / len(present) if present else math.nan, digits)


def _quotient(a: float, b: float) -> float:
    return a / b if b else math.nan


def number(value: float, digits: int) -> str:
    """A number for a table; - for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
