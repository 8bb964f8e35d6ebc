"""The table of ``scripts/bench_truth --localise``."""

import statistics
from collections.abc import Callable, Iterable, Sequence

from .localising import LocaliseRow, Scores

_COLUMNS: tuple[tuple[str, int, int, Callable[[Scores], float | None]], ...] = (
    ("asked", 6, 0, lambda s: s.questions),
    ("known", 6, 0, lambda s: s.known),
    ("p50 m", 6, 2, lambda s: s.p50_m),
    ("p90 m", 6, 2, lambda s: s.p90_m),
    ("plain", 6, 2, lambda s: s.plain_p50_m),
    ("pl.p90", 6, 2, lambda s: s.plain_p90_m),
    ("place", 6, 2, lambda s: s.place_p50_m),
    ("×plain", 7, 2, lambda s: against_plain(s)),
    ("in1.5", 6, 2, lambda s: s.within),
    ("pl.1.5", 6, 2, lambda s: s.plain_within),
    ("AUROC", 6, 3, lambda s: s.auroc),
    ("cosine", 6, 3, lambda s: s.cosine_auroc),
    ("k>unk", 6, 2, lambda s: s.known_called_unknown),
    ("unk>k", 6, 2, lambda s: s.unknown_called_known),
    ("ECE kn", 6, 3, lambda s: s.known_ece),
    ("floor", 6, 3, lambda s: s.known_floor),
    ("ECE co", 6, 3, lambda s: s.confidence_ece),
    ("floor", 6, 3, lambda s: s.confidence_floor),
    ("cpu ms", 6, 1, lambda s: s.cpu_ms),
)
_NAME = 26


def against_plain(scores: Scores) -> float | None:
    """Our median error divided by that of the ten nearest observations."""
    if scores.p50_m is None or not scores.plain_p50_m:
        return None
    return scores.p50_m / scores.plain_p50_m


def localise_table(rows: Sequence[LocaliseRow], *, lines: bool = True) -> str:
    """For each map and kind of question a line for each building, then means by robot and of all,
    and last the building that is worst beside the plain recipe. Without ``lines`` means only."""
    parts = []
    for rule in dict.fromkeys(row.map for row in rows):
        own = [row for row in rows if row.map == rule]
        parts += [_part(rule, kind, own, lines=lines) for kind in own[0].scores]
    return "\n\n".join(parts)


def _part(rule: str, kind: str, rows: Sequence[LocaliseRow], *, lines: bool) -> str:
    text = [_line(f"{kind}, {rule}", (head for head, *_ in _COLUMNS))]
    if lines:
        text += [_line(row.name, _cells([row.scores[kind]])) for row in rows]
    robots = list(dict.fromkeys(row.name.split()[0] for row in rows))
    for robot in robots if 1 < len(robots) < len(rows) else []:
        own = [row.scores[kind] for row in rows if row.name.split()[0] == robot]
        text.append(_line(f"  {robot}", _cells(own)))
    text.append(_line("mean", _cells([row.scores[kind] for row in rows])))
    worst = max(rows, key=lambda row: against_plain(row.scores[kind]) or 0.0)
    text.append(_line(f"worst {worst.name}", _cells([worst.scores[kind]])))
    return "\n".join(text)


def _cells(scores: Sequence[Scores]) -> Iterable[str]:
    for _, _, digits, value in _COLUMNS:
        present = [each for one in scores if (each := value(one)) is not None]
        yield f"{statistics.fmean(present):.{digits}f}" if present else "-"


def _line(name: str, cells: Iterable[str]) -> str:
    widths = (width for _, width, *_ in _COLUMNS)
    shown = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
    return name.ljust(_NAME) + " ".join(shown)
