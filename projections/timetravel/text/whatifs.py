"""`mapfold whatif` for people: one row per setting, then how each differs from the first."""

from collections.abc import Iterator

from projections.partitions import Regrouping
from projections.timetravel.whatif import Alternative, WhatIf

from .table import shortened, table

_HEADER = ("settings", "places", "noise", "merges", "objects", "places ARI", "objects ARI")
_TRUTH_HEADER = ("rooms V", "instances V")
HINT = "--json lists all"


def whatif_text(found: WhatIf, *, most: int | None) -> str:
    """The table, and below it which places split and joined, ``most`` of them per setting."""
    truth = found.base.outcome.scores is not None
    header = (*_HEADER, *_TRUTH_HEADER) if truth else _HEADER
    rows = [_row(each, truth=truth) for each in found.all]
    lines = [line for each in found.alternatives for line in _differences(each, most)]
    return table(header, rows, right=header[1:]) + "".join(f"{x}\n" for x in lines)


def _row(each: Alternative, *, truth: bool) -> tuple[str, ...]:
    counts = each.outcome.counts
    row = (
        each.name,
        f"{counts['places']:,}",
        f"{counts['noise']:,}",
        f"{each.outcome.merges:,}",
        f"{counts['objects']:,}",
        f"{float(each.places.adjusted_rand):.3f}",
        f"{float(each.objects.adjusted_rand):.3f}",
    )
    return (*row, *_scores(each)) if truth else row


def _scores(each: Alternative) -> tuple[str, ...]:
    scores = each.outcome.scores or {}
    return tuple(
        f"{scores[table]['v_measure']:.3f}" if scores[table][scored] else "-"
        for table, scored in (("places", "keyframes"), ("objects", "observations"))
    )


def _differences(each: Alternative, most: int | None) -> Iterator[str]:
    yield ""
    yield f"{each.name}: {_partings(each)}"
    splits = [f"  {_split(found)}" for found in each.places.splits]
    joins = [f"  {_join(found)}" for found in each.places.joins]
    yield from shortened([*splits, *joins], most, HINT)


def _partings(each: Alternative) -> str:
    if each.parted_places is None and each.parted_objects is None:
        return "the same map, event by event"
    return "; ".join(
        _parting(what, offset, same=compared.same)
        for what, offset, compared in (
            ("places", each.parted_places, each.places),
            ("objects", each.parted_objects, each.objects),
        )
    )


def _parting(what: str, offset: int | None, *, same: bool) -> str:
    if offset is None:
        return f"{what} are the same"
    return f"{what} part ways at offset {offset:,}" + (" and end the same" if same else "")


def _split(found: Regrouping) -> str:
    return f"{found.group} splits into {_pieces(found)}"


def _join(found: Regrouping) -> str:
    return f"{found.group} joins {_pieces(found)}"


def _pieces(found: Regrouping) -> str:
    shown = [f"{p.group or 'noise'} ({p.count:,})" for p in found.pieces]
    return ", ".join(shown[:8]) + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")
