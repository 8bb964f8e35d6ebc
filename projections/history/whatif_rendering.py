"""Text output of `mapfold whatif`."""

from collections.abc import Iterator

from eventsrc.base.text import table
from eventsrc.envelope.model import Offset
from projections.map.partitions import Regrouping
from projections.map.phrases import command_title

from .rendering import shortened
from .whatif import Alternative, WhatIf

_HEADER = ("settings", "places", "noise", "merges", "objects", "places ARI", "objects ARI")
_TRUTH_HEADER = ("rooms V", "instances V")
_WHATIF_HINT = "--json lists all"


def whatif_text(found: WhatIf, *, most: int | None) -> str:
    """The table of settings, then up to ``most`` places per setting that split or joined."""
    truth = found.base.result.scores is not None
    header = (*_HEADER, *_TRUTH_HEADER) if truth else _HEADER
    rows = [_row(each, truth=truth) for each in found.all]
    lines = [line for each in found.alternatives for line in _differences(found, each, most)]
    return table(header, rows, right=header[1:]) + "".join(f"{x}\n" for x in lines)


def _row(each: Alternative, *, truth: bool) -> tuple[str, ...]:
    counts = each.result.counts
    row = (
        each.name,
        f"{counts['places']:,}",
        f"{counts['noise']:,}",
        f"{each.result.merges:,}",
        f"{counts['objects']:,}",
        f"{float(each.places.adjusted_rand):.3f}",
        f"{float(each.objects.adjusted_rand):.3f}",
    )
    return (*row, *_scores(each)) if truth else row


def _scores(each: Alternative) -> tuple[str, ...]:
    scores = each.result.scores or {}
    return tuple(
        f"{scores[table]['v_measure']:.3f}" if scores[table][scored] else "-"
        for table, scored in (("places", "keyframes"), ("objects", "observations"))
    )


def _differences(found: WhatIf, each: Alternative, most: int | None) -> Iterator[str]:
    yield ""
    same_digest = each.result.digest == found.base.result.digest
    yield f"{each.name}: {_first_differences(each, same_digest=same_digest)}"
    if each.without is not None:
        yield f"  left out: {command_title(each.without.command)}"
    for place, (before, after) in each.renamed.items():
        yield f"  {place}: {_quoted(before)} in the base, {_quoted(after)} here"
    splits = [f"  {_split(group)}" for group in each.places.splits]
    joins = [f"  {_join(group)}" for group in each.places.joins]
    yield from shortened([*splits, *joins], most, _WHATIF_HINT)


def _quoted(name: str | None) -> str:
    return "no name" if name is None else f'"{name}"'


def _first_differences(each: Alternative, *, same_digest: bool) -> str:
    if each.places_part_at is None and each.objects_part_at is None:
        same = "map" if same_digest else "places and objects"
        return f"the same {same}, event by event"
    return "; ".join(
        _first_difference(what, offset, same=compared.same)
        for what, offset, compared in (
            ("places", each.places_part_at, each.places),
            ("objects", each.objects_part_at, each.objects),
        )
    )


def _first_difference(what: str, offset: Offset | None, *, same: bool) -> str:
    if offset is None:
        return f"{what} are the same"
    return f"{what} differ from offset {offset:,} on" + (
        ", and are the same at the end" if same else ""
    )


def _split(found: Regrouping) -> str:
    return f"{found.group} splits into {_pieces(found)}"


def _join(found: Regrouping) -> str:
    return f"{found.group} joins {_pieces(found)}"


def _pieces(found: Regrouping) -> str:
    shown = [f"{p.group or 'noise'} ({p.count:,})" for p in found.pieces]
    return ", ".join(shown[:8]) + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")
