"""Text output of `mapfold diff`: what changed, a line per kind and a line per thing; and of
`mapfold whatif`, which compares maps of one log.

Of Objects first what the fold says has moved, farthest first, and what is missing; then what may
have moved or be missing; new ones, confirmed first; shifts without a move are one line.
"""

from collections.abc import Iterator, Sequence

from eventsrc.base.text import counted, table
from eventsrc.envelope.model import Offset
from projections.ask.object_changes import ObjectAbsence, ObjectMove, ObjectRow
from projections.map.partitions import Regrouping
from projections.map.phrases import command_title

from .diff import Difference, PlaceRow, place_shift_m
from .rendering import shortened
from .whatif import Alternative, WhatIf

_HINT = "--all shows them"
_MOVED_M = 0.005
"""A shorter move is not printed: it would be 0.00 m."""


def difference_text(diff: Difference, *, most: int | None) -> str:
    """The digests, a line per kind, and up to ``most`` things of each kind; None for all."""
    return "".join(f"{line}\n" for line in _difference_lines(diff, most))


def _difference_lines(diff: Difference, most: int | None) -> Iterator[str]:
    first, second = diff.digests
    if diff.same:
        yield f"the same map at {diff.start:,} and {diff.end:,}: digest {first[:16]}"
        return
    yield f"from {diff.start:,} to {diff.end:,}: digest {first[:16]} → {second[:16]}"
    if diff.commands:
        yield f"commands   {len(diff.commands):,} in between"
        lines = [f"{c.offset:,}  {command_title(c.command)}" for c in diff.commands]
        yield from (f"  {line}" for line in shortened(lines, most, _HINT))
    yield f"keyframes  {_keyframes(diff)}"
    for title, summary, groups in (_places(diff), _objects(diff, most), _edges(diff)):
        yield f"{title:<11}{summary}"
        for group in groups:
            yield from (f"  {line}" for line in shortened(group, most, _HINT))


def _keyframes(diff: Difference) -> str:
    found = diff.keyframes
    relabelled = [(b.place_id, a.place_id) for b, a in found.changed]
    out_of_noise = sum(before is None for before, _ in relabelled)
    parts = [
        (len(found.added), "new"),
        (len(found.removed), "gone"),
        (out_of_noise, "left noise"),
        (len(relabelled) - out_of_noise, "changed place"),
    ]
    return _counts_text(parts)


def _counts_text(parts: Sequence[tuple[int, str]]) -> str:
    return ", ".join(f"{count:,} {what}" for count, what in parts if count) or "unchanged"


def _places(diff: Difference) -> tuple[str, str, list[list[str]]]:
    found = diff.places
    parts = [
        (len(found.added), "formed"),
        (len(found.removed), "gone"),
        (len(found.changed), "changed"),
    ]
    groups = [
        [f"+ {_place_row_text(row)}" for row in found.added],
        [f"- {_title(row)}{_into(diff, row)}" for row in found.removed],
        [f"~ {_place_change(before, after)}" for before, after in found.changed],
    ]
    return "places", _counts_text(parts), groups


def _size(row: PlaceRow) -> str:
    return counted(row.keyframe_count, "keyframe")


def _place_row_text(row: PlaceRow) -> str:
    x, y = row.centroid_x, row.centroid_y
    return f"{_title(row)}: {_size(row)} around ({x:.2f}, {y:.2f})"


def _title(row: PlaceRow) -> str:
    return row.place_id if row.name is None else f'{row.place_id} "{row.name}"'


def _into(diff: Difference, row: PlaceRow) -> str:
    if row.place_id not in diff.absorbed:
        return f" ({_size(row)})"
    survivor, cause = diff.absorbed[row.place_id]
    return f" ({_size(row)}) into {survivor} at {cause.offset:,} ({cause.name})"


def _place_change(before: PlaceRow, after: PlaceRow) -> str:
    moved = place_shift_m(before, after)
    shift = f", centre moved {moved:.2f} m" if moved >= _MOVED_M else ""
    size = f"{before.keyframe_count:,} → {_size(after)}{shift}"
    if before.name == after.name:
        return f"{_title(after)}: {size}"
    named = f"{_quoted(before.name)} → {_quoted(after.name)}"
    unchanged = before.keyframe_count == after.keyframe_count and not shift
    return f"{after.place_id}: {named if unchanged else f'{named}, {size}'}"


def _quoted(name: str | None) -> str:
    return "no name" if name is None else f'"{name}"'


def _objects(diff: Difference, most: int | None) -> tuple[str, str, list[list[str]]]:
    found, became = diff.objects, diff.became
    moved = {move.after.object_id for move in became.moved}
    others = [pair for pair in found.changed if pair[1].object_id not in moved]
    joined = [row for row in found.removed if row.object_id in became.joined]
    gone = [row for row in found.removed if row.object_id not in became.joined]
    elsewhere = [
        pair for pair in others if _now(diff, pair[0].place_id) != _now(diff, pair[1].place_id)
    ]
    renamed = sum(b.place_id != a.place_id for b, a in others) - len(elsewhere)
    sure = sum(move.sure for move in became.moved)
    missing = [each for each in became.missing if not each.back]
    parts = [
        (sure, "moved"),
        (len(became.moved) - sure, "may have moved"),
        (sum(each.sure for each in missing), "missing"),
        (sum(not each.sure for each in missing), "may be missing"),
        (len(became.missing) - len(missing), "back"),
        (len(found.added), f"new{_of_once(found.added)}"),
        (len(joined), "joined into others"),
        (len(gone), f"gone{_of_once(gone)}"),
        (sum(len(after.det_ids) > len(before.det_ids) for before, after in others), "seen again"),
        (len(elsewhere), "in another place"),
        (renamed, "in a place that merged"),
    ]
    new = {row: f"+ {_name(row)} in {row.place_id or 'no place'}" for row in found.added}
    old = {row: f"- {_name(row)}" for row in gone}
    groups = [
        [_move_text(diff, move) for move in became.moved if move.sure],
        [_absence_text(each) for each in became.missing if each.sure],
        [_move_text(diff, move) for move in became.moved if not move.sure],
        [_absence_text(each) for each in became.missing if not each.sure],
        [text for row, text in new.items() if row.confirmed],
        _seen_once("+", [text for row, text in new.items() if not row.confirmed], most),
        [
            f"- {o.object_id} {o.class_name}: joined into {became.joined[o.object_id]}"
            for o in joined
        ],
        [text for row, text in old.items() if row.confirmed],
        _seen_once("-", [text for row, text in old.items() if not row.confirmed], most),
        [f"@ {_object_change(diff, *pair)}" for pair in elsewhere],
        [
            f"~ {text}"
            for pair in others
            if pair not in elsewhere and (text := _object_change(diff, *pair))
        ],
        list(_shifts(diff)),
    ]
    return "objects", _counts_text(parts), groups


def _now(diff: Difference, place_id: str | None) -> str | None:
    """The place that a place of the first map is part of in the second one."""
    while place_id in diff.absorbed:
        place_id = diff.absorbed[place_id][0]
    return place_id


def _of_once(rows: Sequence[ObjectRow]) -> str:
    once = sum(not row.confirmed for row in rows)
    return f" ({once:,} seen once)" if once else ""


def _seen_once(sign: str, lines: list[str], most: int | None) -> list[str]:
    """One line for Objects that are not confirmed, unless all are listed."""
    return lines if most is None or not lines else [f"{sign} {len(lines):,} seen once"]


def _move_text(diff: Difference, move: ObjectMove) -> str:
    before, after = move.before, move.after
    places = _places_text(diff, before, after)
    says = "moved" if move.sure else "may have moved"
    return (
        f"{'>' if move.sure else '?'} {_name(after)}: {says}"
        f" {move.distance_m:.2f} ± {move.error_m:.2f} m,"
        f" {_spot_text(before)} → {_spot_text(after)}{places and f', {places}'}"
    )


def _absence_text(found: ObjectAbsence) -> str:
    says = "back" if found.back else "missing" if found.sure else "may be missing"
    where = f"{_spot_text(found.before)}, {found.before.place_id or 'no place'}"
    return f"{'!' if found.sure else '?'} {_name(found.after)}: {says} at {where}"


def _name(row: ObjectRow) -> str:
    return f"{row.object_id} {row.class_name}"


def _spot_text(row: ObjectRow) -> str:
    x, y = row.spot
    return f"({x:.2f}, {y:.2f})"


def _places_text(diff: Difference, before: ObjectRow, after: ObjectRow) -> str:
    """``run_p0 → run_p1``; empty in one place, or where the two have become one."""
    if _now(diff, before.place_id) == _now(diff, after.place_id):
        return ""
    return f"{before.place_id or 'no place'} → {after.place_id or 'no place'}"


def _object_change(diff: Difference, before: ObjectRow, after: ObjectRow) -> str:
    """Empty where nothing is to be said."""
    parts = []
    if before.class_name != after.class_name:
        parts.append(f"{before.class_name} → {after.class_name}")
    if places := _places_text(diff, before, after):
        parts.append(places)
    if len(before.det_ids) != len(after.det_ids):
        now = counted(len(after.det_ids), "time")
        parts.append(f"seen {len(before.det_ids):,} → {now}")
    if before.estimate is not None and after.estimate is not None:
        errors = f"± {before.estimate.est_sigma_m:.2f} → {after.estimate.est_sigma_m:.2f} m"
        parts += [errors] if before.estimate != after.estimate else []
    return f"{_name(after)}: {', '.join(parts)}" if parts else ""


def _shifts(diff: Difference) -> Iterator[str]:
    """The line that counts what shifted without having moved."""
    jitter, corrected = diff.became.jitter, diff.became.corrected
    if jitter and any(after.estimate is None for _, after in diff.objects.changed):
        yield (
            f"{counted(jitter, 'object')} seen from elsewhere in the mean, which is no move;"
            " --preset full estimates where things stand"
        )
    elif jitter or corrected:
        more = f", {corrected:,} by more without having moved" if corrected else ""
        whose = "its" if jitter == 1 else "their"
        yield f"{counted(jitter, 'other')} shifted by less than {whose} error{more}"


def _edges(diff: Difference) -> tuple[str, str, list[list[str]]]:
    found = diff.edges
    parts = [
        (len(found.added), "new"),
        (len(found.removed), "gone"),
        (len(found.changed), "changed"),
    ]
    groups = [
        [f"+ {e.a} – {e.b}: {counted(e.shared_transitions, 'transition')}" for e in found.added],
        [f"- {e.a} – {e.b}" for e in found.removed],
        [
            f"~ {after.a} – {after.b}: {before.shared_transitions:,} → {after.shared_transitions:,}"
            for before, after in found.changed
        ],
    ]
    return "adjacency", _counts_text(parts), groups


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
