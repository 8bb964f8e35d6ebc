"""What changed in the building between two moments: moved, missing, new and back again.

`map_changes` compares two maps of one log. Only what is sure counts; what may be is counted in
``unsure``. Of moved, missing and back again Objects `object_changes` says what is sure. An Object
is *new* when the first map does not have it, it is confirmed, and the keyframes before had looked
at where it stands (`fold.presence.would_see`) so often, without seeing anything of its class there,
that they would have seen it `_EXPECTED` times, by the share of the keyframes since that look there
and see it. What the robot only had not looked at before, or often overlooks, is not new.

Changes come by kind: moved, the farthest first; then missing, new and back, those seen most often
first.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import Offset
from projections.map.naming import ShortIds, things_of
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.view import MapView

from .find import SeenAt, seen_at
from .object_changes import (
    KNOWN_M,
    Point,
    became,
    is_within,
    keyframes_looking,
    keyframes_of,
    object_rows,
)

ChangeKind = Literal["moved", "missing", "new", "back"]
KINDS: Final[tuple[ChangeKind, ...]] = ("moved", "missing", "new", "back")

_EXPECTED: Final = 4.0
"""On the developing half of generated buildings, with eight more robots, 220 of 226 such are new;
where six looks are enough, however often they overlook, 242 of 256."""


@dataclass(frozen=True, slots=True)
class MapChange:
    """One change of an Object: where it was (``from_``, None for new) and is (``to``, None for
    missing), in metres, and how far it moved. ``place_id`` is that of the place where it is, or,
    missing, was. ``seen`` is the keyframe that shows it: the first one of a move, of a new Object
    and of one that is back; of a missing one the last that saw it."""

    kind: ChangeKind
    object_id: str
    class_name: str
    place_id: str | None
    place_name: str | None
    place_type: str | None
    from_: Point | None
    to: Point | None
    moved_m: float | None
    error_m: float | None
    obs_count: int
    seen: SeenAt
    sentence: str

    def __repr__(self) -> str:
        return f"<{self.sentence}>"

    def document(self) -> dict[str, Any]:
        """As JSON; ``from_`` is ``from``."""
        return {name.removesuffix("_"): value for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class MapChanges:
    """The changes between the map after ``since`` events and that after ``until``, and how many
    more are not sure."""

    since: Offset
    until: Offset
    changes: tuple[MapChange, ...]
    unsure: int

    def __repr__(self) -> str:
        counts = ", ".join(f"{sum(c.kind == k for c in self.changes):,} {k}" for k in KINDS)
        return f"<changes from {self.since:,} to {self.until:,}: {counts}, {self.unsure:,} unsure>"

    def document(self) -> dict[str, Any]:
        """As JSON, with the number of changes of each kind."""
        return {
            "since": self.since,
            "until": self.until,
            "counts": {kind: sum(c.kind == kind for c in self.changes) for kind in KINDS},
            "unsure": self.unsure,
            "changes": [change.document() for change in self.changes],
        }


def map_changes(first: MapView, second: MapView) -> MapChanges:
    """What changed from one map to a later one of the same log, folded by evidence."""
    before, after = object_rows(first), object_rows(second)
    found = became(first, second, before, after)
    writer = _Writer(second)
    changes, unsure = list[MapChange](), 0
    for move in found.moved:
        if not move.sure:
            unsure += 1
            continue
        record = writer.objects[move.after.object_id]
        known = {each.offset for each in move.before.relocations}
        offset = max(r.offset for r in record.relocations if r.offset not in known)
        spots = move.before.spot, move.after.spot
        changes.append(writer.change("moved", record, *spots, offset, move.error_m))
    for absence in found.missing:
        if not absence.sure:
            unsure += 1
            continue
        record = writer.objects[absence.after.object_id]
        spot = absence.after.spot
        if absence.back:
            later = [k.offset for k in second.sightings(record) if k.offset >= first.next_offset]
            changes.append(writer.change("back", record, None, spot, min(later, default=None)))
        else:
            changes.append(writer.change("missing", record, spot, None))
    news, doubtful = _new(first, second)
    changes += [writer.change("new", record, None, record.spot) for record in news]
    kinds = {kind: number for number, kind in enumerate(KINDS)}
    changes.sort(key=lambda c: (kinds[c.kind], -(c.moved_m or 0.0), -c.obs_count, c.object_id))
    return MapChanges(first.next_offset, second.next_offset, tuple(changes), unsure + doubtful)


def run_span(view: MapView, run_id: str) -> tuple[Offset, Offset] | None:
    """The offsets of the first event of a run and after its last; None for no such run."""
    run = next((run for run in view.runs if run.run_id == run_id), None)
    if run is None:
        return None
    offsets = [k.offset for k in view.once(keyframes_of) if k.run == run.ordinal]
    return Offset(min(offsets)), Offset(max(offsets) + 1)


def last_run_start(view: MapView) -> Offset:
    """The offset at which the run began that began last; 0 where it is the only one."""
    starts = dict[int, Offset]()
    for keyframe in view.once(keyframes_of):
        starts.setdefault(keyframe.run, keyframe.offset)
    return max(starts.values()) if len(starts) > 1 else Offset(0)


def changes_text(found: MapChanges, most: int | None = None) -> str:
    """A sentence for each change, at most so many of a kind."""
    lines = list[str]()
    for kind in KINDS:
        of_kind = [change.sentence for change in found.changes if change.kind == kind]
        lines += of_kind[:most]
        if most is not None and len(of_kind) > most:
            lines.append(f"… and {len(of_kind) - most:,} more {kind}")
    return "".join(f"{line}\n" for line in lines) or "nothing changed for sure\n"


def _new(first: MapView, second: MapView) -> tuple[list[ObjectRecord], int]:
    """The Objects that are new for sure, and how many others may be."""
    known = {each.object_id for each in first.all_objects}
    there = dict[str, list[ObjectRecord]]()
    for each in first.objects.values():
        there.setdefault(each.class_name, []).append(each)
    keyframes = second.once(keyframes_of)
    sure, doubtful = list[ObjectRecord](), 0
    for record in second.objects.values():
        at = record.estimate
        if record.object_id in known or not record.confirmed or at is None or record.missing_in:
            continue
        seen = set(second.seen_by(record))
        if keyframes[min(seen)].offset < first.next_offset:
            continue
        alike = any(is_within(e.estimate, at) for e in there.get(record.class_name, ()))
        if at.est_sigma_m > KNOWN_M or alike:
            doubtful += 1
        else:
            looks = list(keyframes_looking(second, record, second))
            before = sum(keyframe.offset < first.next_offset for keyframe in looks)
            hits = sum(keyframe.ordinal in seen for keyframe in looks)
            if before * (hits + 1) >= _EXPECTED * (len(looks) - before + 2):
                sure.append(record)
    return sure, doubtful


class _Writer:
    """Makes changes of the Objects of a map."""

    def __init__(self, view: MapView) -> None:
        self._view = view
        self._short = ShortIds.of(things_of(view))
        self._at: Mapping[int, KeyframeRecord] = {k.offset: k for k in view.once(keyframes_of)}
        self.objects = {each.object_id: each for each in view.objects.values()}

    def change(
        self,
        kind: ChangeKind,
        record: ObjectRecord,
        from_: Point | None,
        to: Point | None,
        offset: int | None = None,
        error_m: float | None = None,
    ) -> MapChange:
        """A change, shown by the event at ``offset``: else the first that saw it, and of a missing
        one the last."""
        view, place = self._view, record.place
        keyframe = None if offset is None else self._at.get(offset)
        if keyframe is None:
            pick = max if kind == "missing" else min
            keyframe = pick(view.sightings(record), key=lambda k: (k.timestamp, k.offset))
        seen = seen_at(keyframe)
        type_ = None if place is None else view.type_of(place)
        moved_m = None if from_ is None or to is None else math.dist(from_, to)
        name = None if place is None else view.all_places[place].name
        kind_of_place = None if type_ is None else type_.type
        return MapChange(
            kind,
            record.object_id,
            record.class_name,
            view.place_id(place),
            name,
            kind_of_place,
            from_,
            to,
            moved_m,
            error_m,
            record.obs_count,
            seen,
            self._sentence(kind, record, from_, to, name or kind_of_place, seen),
        )

    def _sentence(
        self,
        kind: ChangeKind,
        record: ObjectRecord,
        from_: Point | None,
        to: Point | None,
        word: str | None,
        seen: SeenAt,
    ) -> str:
        """``couch obj-5bf2dc moved 2.31 m: from (1.20, 3.40) to (3.10, 4.40) in p3 kitchen.``"""
        thing = f"{visible(record.class_name)} {self._short(record.object_id)}"
        where = "in no place"
        if record.place is not None:
            place_id = visible(self._short(self._view.place_id(record.place) or ""))
            where = f"in {place_id}" + ("" if word is None else f" {visible(word)}")
        by = f"{seen.iso} by {visible(seen.run_id)}:{seen.keyframe_id}"
        if from_ is not None and to is not None:
            way = f"from ({from_[0]:.2f}, {from_[1]:.2f}) to ({to[0]:.2f}, {to[1]:.2f})"
            return f"{thing} moved {math.dist(from_, to):.2f} m: {way} {where}, seen {by}."
        x, y = from_ or to or (math.nan, math.nan)
        at = f"({x:.2f}, {y:.2f}) {where}"
        if kind == "missing":
            return f"{thing} is missing from {at}; last seen {by}."
        again = "back" if kind == "back" else "new"
        times = counted(record.obs_count, "time")
        return f"{thing} is {again} at {at}, seen {times} since {by}."
