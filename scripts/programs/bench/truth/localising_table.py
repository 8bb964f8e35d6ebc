"""The table of ``scripts/bench_truth --localise``."""

from collections.abc import Iterable, Sequence

from .localising import LocaliseRow, Scores
from .tables import mean_of

_COLUMNS = (
    ("asked", 6, "questions", 0),
    ("known", 6, "known", 0),
    ("p50 m", 6, "p50_m", 2),
    ("p90 m", 6, "p90_m", 2),
    ("plain", 6, "plain_p50_m", 2),
    ("pl.p90", 6, "plain_p90_m", 2),
    ("place", 6, "place_p50_m", 2),
    ("×plain", 7, "against_plain", 2),
    ("in1.5", 6, "within", 2),
    ("pl.1.5", 6, "plain_within", 2),
    ("AUROC", 6, "auroc", 3),
    ("cosine", 6, "cosine_auroc", 3),
    ("k>unk", 6, "known_called_unknown", 2),
    ("unk>k", 6, "unknown_called_known", 2),
    ("ECE kn", 6, "known_ece", 3),
    ("floor", 6, "known_floor", 3),
    ("ECE co", 6, "confidence_ece", 3),
    ("floor", 6, "confidence_floor", 3),
    ("10 k>u", 6, "session_known_called_unknown", 2),
    ("10 u>k", 6, "session_unknown_called_known", 2),
    ("10 ECE", 6, "session_ece", 3),
    ("cpu ms", 6, "cpu_ms", 1),
)
"""Heads, widths, fields of `Scores`, digits."""
_NAME = 26


def localise_table(rows: Sequence[LocaliseRow], *, lines: bool = True) -> str:
    """For each map and kind of question a line for each building, then means by robot and of all,
    and last the building that is worst beside the plain baseline. Without ``lines`` means only."""
    parts = []
    for rule in dict.fromkeys(row.map for row in rows):
        own = [row for row in rows if row.map == rule]
        parts += [_part(rule, kind, own, lines=lines) for kind in own[0].scores]
    estimated = [row for row in rows if row.camera.hfov_error_deg is not None]
    if estimated:
        parts.append(_fields_of_view(estimated))
    return "\n\n".join(parts)


def _fields_of_view(rows: Sequence[LocaliseRow]) -> str:
    """Of each map the true field of view, the estimated one with its error, and how far it is
    off."""
    heads = ("field of view, estimated", "true", "map", "error", "off")
    lines = ["{:<26} {:>6} {:>6} {:>6} {:>6}".format(*heads)]
    for row in rows:
        found, error = row.camera.hfov_deg or 0.0, row.camera.hfov_error_deg or 0.0
        off = found - row.hfov_deg
        lines.append(f"{row.name:<26} {row.hfov_deg:6.1f} {found:6.1f} {error:6.1f} {off:+6.1f}")
    return "\n".join(lines)


def _part(rule: str, kind: str, rows: Sequence[LocaliseRow], *, lines: bool) -> str:
    text = [_line(f"{kind}, {rule}", (head for head, *_ in _COLUMNS))]
    if lines:
        text += [_line(row.name, _cells([row.scores[kind]])) for row in rows]
    robots = list(dict.fromkeys(row.name.split()[0] for row in rows))
    for robot in robots if 1 < len(robots) < len(rows) else []:
        own = [row.scores[kind] for row in rows if row.name.split()[0] == robot]
        text.append(_line(f"  {robot}", _cells(own)))
    text.append(_line("mean", _cells([row.scores[kind] for row in rows])))
    worst = max(rows, key=lambda row: row.scores[kind].against_plain or 0.0)
    text.append(_line(f"worst {worst.name}", _cells([worst.scores[kind]])))
    return "\n".join(text)


def _cells(scores: Sequence[Scores]) -> Iterable[str]:
    return (mean_of(scores, field, digits) for _, _, field, digits in _COLUMNS)


def _line(name: str, cells: Iterable[str]) -> str:
    widths = (width for _, width, *_ in _COLUMNS)
    shown = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
    return name.ljust(_NAME) + " ".join(shown)
