"""`mapfold diff` for people: the digests, a line per kind, then the things that changed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from eventsrc.words import counted
from projections.timetravel.difference import Difference, object_shift_m, place_shift_m
from projections.timetravel.rows import ObjectRow, PlaceRow

from .table import shortened

HINT = "--all shows them"
_MOVED_M = 0.005
"""Less than this is not told as a move: it would print as 0.00 m."""


def difference_text(diff: Difference, *, most: int | None) -> str:
    """What changed; ``most`` things are named of each kind, all of them for None."""
    return "".join(f"{line}\n" for line in _lines(diff, most))


def _lines(diff: Difference, most: int | None) -> Iterator[str]:
    first, second = diff.digests
    if diff.same:
        yield f"the same map at {diff.start:,} and {diff.end:,}: digest {first[:16]}"
        return
    yield f"from {diff.start:,} to {diff.end:,}: digest {first[:16]} → {second[:16]}"
    yield f"keyframes  {_keyframes(diff)}"
    for title, summary, groups in (_places(diff), _objects(diff), _edges(diff)):
        yield f"{title:<11}{summary}"
        for group in groups:
            yield from (f"  {line}" for line in shortened(group, most, HINT))


def _keyframes(diff: Difference) -> str:
    found = diff.keyframes
    relabelled = [(b.place_id, a.place_id) for b, a in found.changed]
    out_of_noise = sum(before is None for before, _ in relabelled)
    parts = [
        (len(found.came), "new"),
        (len(found.went), "gone"),
        (out_of_noise, "left noise"),
        (len(relabelled) - out_of_noise, "changed place"),
    ]
    return _parts(parts)


def _parts(parts: Sequence[tuple[int, str]]) -> str:
    return ", ".join(f"{count:,} {what}" for count, what in parts if count) or "unchanged"


def _places(diff: Difference) -> tuple[str, str, list[list[str]]]:
    found = diff.places
    parts = [
        (len(found.came), "formed"),
        (len(found.went), "gone"),
        (len(found.changed), "changed"),
    ]
    groups = [
        [f"+ {_place(row)}" for row in found.came],
        [f"- {row.place_id}{_into(diff, row)}" for row in found.went],
        [f"~ {_place_change(before, after)}" for before, after in found.changed],
    ]
    return "places", _parts(parts), groups


def _size(row: PlaceRow) -> str:
    return counted(row.keyframe_count, "keyframe")


def _place(row: PlaceRow) -> str:
    x, y = row.centroid_x, row.centroid_y
    return f"{row.place_id}: {_size(row)} around ({x:.2f}, {y:.2f})"


def _into(diff: Difference, row: PlaceRow) -> str:
    if row.place_id not in diff.absorbed:
        return f" ({_size(row)})"
    survivor, cause = diff.absorbed[row.place_id]
    return f" ({_size(row)}) into {survivor} at {cause.offset:,} ({cause.name})"


def _place_change(before: PlaceRow, after: PlaceRow) -> str:
    moved = place_shift_m(before, after)
    shift = f", centre moved {moved:.2f} m" if moved >= _MOVED_M else ""
    return f"{after.place_id}: {before.keyframe_count:,} → {_size(after)}{shift}"


@dataclass(frozen=True, slots=True)
class _ObjectChange:
    before: ObjectRow
    after: ObjectRow

    @property
    def relocated(self) -> bool:
        return self.before.place_id != self.after.place_id

    @property
    def seen(self) -> int:
        return len(self.after.det_ids) - len(self.before.det_ids)

    def text(self) -> str:
        after, shift = self.after, object_shift_m(self.before, self.after)
        parts = [f"{after.object_id} {after.class_name}:"]
        if self.relocated:
            parts.append(f"{self.before.place_id or 'no place'} → {after.place_id or 'no place'}")
        if self.seen:
            now = counted(len(after.det_ids), "time")
            parts.append(f"seen {len(self.before.det_ids):,} → {now}")
        if shift >= _MOVED_M:
            parts.append(f"moved {shift:.2f} m")
        return parts[0] + " " + ", ".join(parts[1:])


def _objects(diff: Difference) -> tuple[str, str, list[list[str]]]:
    found = diff.objects
    changed = [_ObjectChange(before, after) for before, after in found.changed]
    relocated = [change for change in changed if change.relocated]
    others = [change for change in changed if not change.relocated]
    parts = [
        (len(found.came), "new"),
        (len(found.went), "gone"),
        (sum(change.seen > 0 for change in changed), "seen again"),
        (len(relocated), "relocated"),
    ]
    groups = [
        [f"+ {o.object_id} {o.class_name} in {o.place_id or 'no place'}" for o in found.came],
        [f"- {o.object_id} {o.class_name}" for o in found.went],
        [f"> {change.text()}" for change in relocated],
        [f"~ {change.text()}" for change in others],
    ]
    return "objects", _parts(parts), groups


def _edges(diff: Difference) -> tuple[str, str, list[list[str]]]:
    found = diff.edges
    parts = [(len(found.came), "new"), (len(found.went), "gone"), (len(found.changed), "changed")]
    groups = [
        [f"+ {e.a} – {e.b}: {counted(e.shared_transitions, 'transition')}" for e in found.came],
        [f"- {e.a} – {e.b}" for e in found.went],
        [
            f"~ {after.a} – {after.b}: {before.shared_transitions:,} → {after.shared_transitions:,}"
            for before, after in found.changed
        ],
    ]
    return "adjacency", _parts(parts), groups
