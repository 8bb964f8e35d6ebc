"""The fold: one envelope in, its deltas out. Runs the reducers and passes deltas between them.

Per keyframe, in this order:

0.  Corrections leave it out, leave detections of it out, or change its pose.
1.  A keyframe folded before changes nothing: it is a duplicate, or a conflict if its content
    differs; the first one stands.
2.  The run, the keyframe and its observations are added. An observation whose det_id an earlier
    keyframe has is left out and reported.
3.  With a pose, the keyframe goes to places, and its observations in the map's embedding space go
    to Objects: one by one under `fusion = "page"`, all together, with those that have no embedding,
    by evidence. Without one it is only added. Floors are laid out beside each other (`floors`).
4.  Names of places, located-in and adjacency add what follows from changes of places and Objects.

The fold has no clock, chance, disk, network or database. The same events give the same deltas.
"""

from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import TypeAlias

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, DetId, Offset, RunId
from eventsrc.envelope.occupancy_map import OccupancyMap

from . import State, part, prefixed
from .constrained_places import ConstrainedPlaces, places_by
from .corrections import NO_CORRECTIONS, Corrections, Keyframe
from .deltas import (
    Delta,
    EventSkipped,
    FusibleObservation,
    KeyframeAdded,
    KeyframeOrdinal,
    KeyframePlaced,
    MapGiven,
    ObjectEstimated,
    ObjectRelocated,
    ObjectSeen,
    ObjectsMerged,
    ObservationAdded,
    ObservationOrdinal,
    PlaceNamed,
    PlaceOrdinal,
    PlacesMerged,
    Pose,
    RunOrdinal,
    RunSeen,
    SkipKind,
)
from .edited_events import EventEdits, Reembedded, Space
from .evidence_fusion import EvidenceFusion, objects_by
from .exact import Units, unit_vectors
from .floors import CurrentMap, Floors
from .folded_ids import FoldedIds, content_digest
from .objects import NO_VECTOR, ConstrainedObjects, Objects
from .pair_groups import PairGroups
from .place_members import PosedKeyframe
from .places import Places
from .relations import Adjacency, LocatedIn, PlaceNames
from .rooms import Rooms
from .settings import Settings
from .sights import body_of, camera_of, pose_error_of, pose_of, sightings_of, with_small_yaw
from .standing import Standing

Reducer: TypeAlias = (
    FoldedIds
    | Floors
    | Places
    | Rooms
    | Objects
    | EvidenceFusion
    | LocatedIn
    | Standing
    | Adjacency
    | CurrentMap
)


class SemanticMap:
    """The fold's state. `fold` changes it in place and is otherwise pure.

    ``next_offset`` is one past the last event folded or skipped, set before an event changes
    anything else: it tells an interrupted fold.
    """

    def __init__(self, settings: Settings, corrections: Corrections = NO_CORRECTIONS) -> None:
        self.settings = settings
        self.corrections = corrections
        self.event_edits = EventEdits(corrections)
        self.names = PlaceNames(corrections.names)
        self._anchors = self._all_anchors()
        self._is_corrected = self.event_edits.any or bool(self._anchors)
        self.next_offset = FIRST_OFFSET
        self.folded_ids = FoldedIds()
        self.floors = Floors(settings.floor_height_m)
        self.space = Space(settings)
        self._grouped = PairGroups(corrections.joined, corrections.apart)
        self.places = places_by(settings, self._grouped)
        self._named = PairGroups(corrections.same, corrections.different)
        self.objects = objects_by(settings, self._named)
        self.current_map = CurrentMap(settings, self.floors)
        self.standing = Standing(self.current_map.floor_at, self.places.survivors)
        self.located_in = LocatedIn(self.standing)
        self.adjacency = Adjacency()
        self.observation_count = 0
        self.reembedded: Reembedded | None = None  # by `projections.map.parsing`
        self._has_vectors = bool(corrections.reembedded_for(settings))

    def use_map(self, offset: Offset, given: OccupancyMap) -> list[Delta]:
        """Put an occupancy map into force for the events after it."""
        self.next_offset = Offset(offset + 1)
        return self._in_force(self.current_map.fold(offset, given))

    def _in_force(self, given: MapGiven | EventSkipped | None) -> list[Delta]:
        if not isinstance(given, MapGiven):
            return [] if given is None else [given]
        self._use_walls()
        self.standing.use_other_map()
        return [given]

    def _use_walls(self) -> None:
        if self.current_map.has_walls and isinstance(self.places, Rooms):
            self.places.use_walls(self.current_map.way_at)

    def skip(self, offset: Offset) -> None:
        """Pass over an event that does not change the map."""
        self.next_offset = Offset(offset + 1)

    def fold(
        self, offset: Offset, accepted: Accepted, units: Sequence[Units | None] | None = None
    ) -> list[Delta]:
        """Fold one envelope; returns the deltas in the order of `projections.fold.deltas`.

        ``units`` is ``unit_vectors(accepted.vectors)``, made beforehand. Raises FoldError where a
        correction cannot be applied; the map is as before the event then."""
        dropped: tuple[DetId, ...] = ()
        frame = accepted.envelope.frame
        is_corrected = self._is_corrected
        if is_corrected and self.event_edits.any:
            edited = self.event_edits.edited(offset, accepted, units)
            if edited is None:
                self.next_offset = Offset(offset + 1)
                run_id, keyframe_id = accepted.envelope.run_id, accepted.envelope.keyframe_id
                return [EventSkipped(offset, "forgotten", run_id, keyframe_id)]
            accepted, units, dropped = edited
        self.next_offset = Offset(offset + 1)
        envelope, folded_ids = accepted.envelope, self.folded_ids
        digest = content_digest(accepted)
        earlier = folded_ids.find(envelope.run_id, envelope.keyframe_id)
        if earlier is not None:
            is_same = folded_ids.digest_of(earlier) == digest
            kind: SkipKind = "duplicate" if is_same else "conflict"
            first = folded_ids.offsets[earlier]
            return [EventSkipped(offset, kind, envelope.run_id, envelope.keyframe_id, None, first)]
        deltas: list[Delta] = []
        run, is_news = folded_ids.add_run(envelope.run_id, envelope.timestamp)
        if is_news:
            deltas.append(RunSeen(offset, run, envelope.run_id, envelope.timestamp))
        keyframe = folded_ids.add_keyframe(run, envelope.keyframe_id, offset, digest)
        pose = pose_of(envelope)
        floor, ground = (None, 0) if pose is None else self.floors.enter(envelope)
        if is_corrected and self._anchors:
            anchor = Keyframe(envelope.run_id, envelope.keyframe_id)
            self._add_anchor(keyframe, anchor, None if pose is None else ground)
        if pose is None or frame == self.floors.frame:
            frame = None
        elif joins := self.corrections.frame_joins(frame):
            deltas += self.floors.join(offset, joins)
        run_id, keyframe_id, at = envelope.run_id, envelope.keyframe_id, envelope.timestamp
        known = (offset, keyframe, run, run_id, keyframe_id, at, pose, floor, envelope.camera)
        deltas.append(KeyframeAdded(*known, frame))
        if units is None:
            units = unit_vectors(accepted.vectors)
        if dropped:
            run_id, keyframe_id = envelope.run_id, envelope.keyframe_id
            deltas += [EventSkipped(offset, "dropped", run_id, keyframe_id, d) for d in dropped]
        if self._has_vectors:
            assert self.reembedded is not None  # noqa: S101
            accepted, units = self.reembedded.applied(accepted, units)
        fusible = self._observe(offset, keyframe, accepted, units, deltas)
        if pose is not None:
            deltas += self._in_force(self.current_map.scan(offset, ground, pose, envelope))
            pose = self.floors.laid_out(pose, ground)
            for seen in fusible if self._named.group_of else ():
                self.floors.keep_to_floor(self._named, seen[1], "object", ground)
            place = self._place(offset, keyframe, run, envelope.run_id, pose, deltas)
            objects, timestamp = self.objects, envelope.timestamp
            if isinstance(objects, EvidenceFusion):
                camera = camera_of(envelope.camera, self.settings.camera)
                sights = self.floors.sightings(sightings_of(accepted, fusible), ground)
                facing = with_small_yaw(pose)
                error = pose_error_of(envelope)
                fused = objects.fold(offset, run, timestamp, facing, camera, sights, error)
                self._locate(fused, keyframe, place)
                if isinstance(self.places, Rooms) and place is not None:
                    self._stand(fused, pose, place)
                deltas += fused
            else:
                x_um, y_um = pose.x_um, pose.y_um
                for seen in fusible:
                    if isinstance(objects, ConstrainedObjects):
                        named = objects.fold_named(offset, seen, timestamp, x_um, y_um)
                        self._locate(named, keyframe, place)
                        deltas += named
                    else:
                        one = objects.fold(offset, seen, timestamp, x_um, y_um)
                        self.located_in.object_seen(one[-1].object, keyframe, place)
                        deltas += one
            deltas += self.located_in.collect_moves(offset)
            deltas += self.adjacency.collect_changes(offset)
        return self.floors.put_back(deltas)

    def _stand(self, fused: Sequence[Delta], pose: Pose, place: PlaceOrdinal) -> None:
        standing, at = self.standing, (pose.x_um, pose.y_um)
        standing.pose_placed(*at, place)
        for delta in fused:
            if type(delta) is ObjectEstimated:
                standing.object_estimated(delta, at)
            elif type(delta) is ObjectsMerged:
                standing.object_absorbed(delta.absorbed)
        if self.current_map.has_walls:
            self.located_in.decide_standing()

    def use_names(self, offset: Offset, corrections: Corrections) -> list[PlaceNamed]:
        """Replace the names of places, as if they had been known from the start; returns the
        deltas. All else in ``corrections`` must be as in the map: ValueError if it is not."""
        if not corrections.differs_in_names_only(self.corrections):
            raise ValueError("these corrections differ in more than names; fold the log again")
        self.corrections = corrections  # first: see `LiveFold`
        older, names = self.names, corrections.names
        if names[: len(older.names)] == older.names:  # time for the new ones only
            self.names, new = older.followed_by(names), names[len(older.names) :]
        else:
            self.names, new = PlaceNames(names), names
        self._anchors = self._all_anchors()
        self._is_corrected = self.event_edits.any or bool(self._anchors)
        for anchor in {name.anchor for name in new}:
            keyframe = self.folded_ids.find(*anchor)
            if keyframe is not None:
                self.names.add_anchor(keyframe, anchor)
                place = self.places.place_of(keyframe)
                if place is not None:
                    self.names.give(keyframe, place)
        return self.names.changes_from(older, offset)

    def dump(self) -> State:
        """Everything but the settings, the corrections and names, to be kept."""
        space = self.space
        own = {
            "next_offset": self.next_offset,
            "observation_count": self.observation_count,
            "space": [space.model, space.dim] if space.is_decided else None,
        }
        parts = (prefixed(name, reducer.dump()) for name, reducer in self._parts())
        return reduce(or_, parts, own)

    def load(self, state: State) -> None:
        """Restore the state of `dump` in a map that has folded nothing yet; `use_names` adds the
        names."""
        self.next_offset = state["next_offset"]
        self.observation_count = state["observation_count"]
        if state["space"] is not None:
            self.space.decide(*state["space"])
        for name, reducer in self._parts():
            reducer.load(part(name, state))
        self.names = PlaceNames(())  # none is given yet
        self._use_walls()

    def _parts(self) -> tuple[tuple[str, Reducer], ...]:
        return (
            ("seen", self.folded_ids),
            ("floors", self.floors),
            ("places", self.places),
            ("landmarks", self.objects),
            ("located_in", self.located_in),
            ("standing", self.standing),
            ("adjacency", self.adjacency),
            ("current_map", self.current_map),
        )

    def _all_anchors(self) -> frozenset[Keyframe]:
        apart, joined = self.corrections.apart, self.corrections.joined
        return frozenset(self.names.newest).union(apart.things, *joined)

    def _add_anchor(self, keyframe: KeyframeOrdinal, anchor: Keyframe, floor: int | None) -> None:
        if anchor in self._anchors:
            self.names.add_anchor(keyframe, anchor)
            if isinstance(self.places, ConstrainedPlaces | Rooms):
                if floor is not None:
                    self.floors.keep_to_floor(self._grouped, anchor, "place", floor)
                self.places.add_anchor(keyframe, anchor)

    def _observe(
        self,
        offset: Offset,
        keyframe: KeyframeOrdinal,
        accepted: Accepted,
        units: Sequence[Units | None],
        deltas: list[Delta],
    ) -> list[FusibleObservation]:
        """Add the observations; returns those to fuse."""
        envelope, det_ids = accepted.envelope, self.folded_ids.det_ids
        run_id, keyframe_id = envelope.run_id, envelope.keyframe_id
        fusible: list[FusibleObservation] = []
        for detection, det_id, unit in zip(
            envelope.detections, accepted.det_ids, units, strict=True
        ):
            model = detection.embedding_model
            is_member = unit is not None and self.space.has(model, len(unit[0]))
            first = det_ids.setdefault(det_id, keyframe)
            if first != keyframe:
                deltas.append(self._det_id_reused(offset, accepted, det_id, first))
                continue
            class_name = detection.class_name
            observation = ObservationOrdinal(self.observation_count)
            deltas.append(
                ObservationAdded(
                    offset,
                    observation,
                    keyframe,
                    run_id,
                    keyframe_id,
                    det_id,
                    class_name,
                    detection.confidence,
                    detection.bbox,
                    model,
                    unit[1] if unit is not None and is_member else None,
                    unit is not None and not is_member,
                    detection.depth_m is not None or detection.position is not None,
                    body_of(detection),
                )
            )
            if unit is not None and is_member:
                fusible.append((observation, det_id, class_name, unit[0], unit[2]))
            elif unit is None and isinstance(self.objects, EvidenceFusion):
                fusible.append((observation, det_id, class_name, NO_VECTOR, 0))
            self.observation_count += 1
        return fusible

    def _det_id_reused(
        self, offset: Offset, accepted: Accepted, det_id: DetId, first: KeyframeOrdinal
    ) -> EventSkipped:
        envelope = accepted.envelope
        at = self.folded_ids.offsets[first]
        return EventSkipped(
            offset, "det_id_reused", envelope.run_id, envelope.keyframe_id, det_id, at
        )

    def _place(
        self,
        offset: Offset,
        keyframe: KeyframeOrdinal,
        run: RunOrdinal,
        run_id: RunId,
        pose: Pose,
        deltas: list[Delta],
    ) -> PlaceOrdinal | None:
        """Run places, report changes to located-in and adjacency; returns the keyframe's place."""
        folded_ids, place = self.folded_ids, None
        changes = self.places.fold(
            PosedKeyframe(offset, keyframe, run, run_id, pose.x_um, pose.y_um)
        )
        for delta in changes:
            deltas.append(delta)
            if type(delta) is KeyframePlaced:
                placed = delta.keyframe
                if placed == keyframe:
                    place = delta.place
                else:
                    self.located_in.keyframe_placed(placed, delta.place)
                self.adjacency.keyframe_placed(
                    folded_ids.run_of[placed], folded_ids.keyframe_ids[placed], delta.place
                )
            elif type(delta) is PlacesMerged:
                self.located_in.places_merged(delta.survivor, delta.absorbed)
                self.adjacency.places_merged(delta.survivor, delta.absorbed)
        if self._is_corrected and self.names.names:
            deltas += self.names.fold(offset, changes)
        return place

    def _locate(
        self, fused: Sequence[Delta], keyframe: KeyframeOrdinal, place: PlaceOrdinal | None
    ) -> None:
        """Report sightings, merges and relocations of Objects to located-in."""
        for number, delta in enumerate(fused, start=1):
            if type(delta) is ObjectSeen:
                self.located_in.object_seen(delta.object, keyframe, place)
            elif type(delta) is ObjectsMerged:
                following = fused[number] if number < len(fused) else None
                if type(following) is ObjectRelocated and following.object == delta.survivor:
                    self.located_in.object_left(delta.survivor)
                self.located_in.objects_merged(delta.survivor, delta.absorbed)
