"""Objects under ``same-object`` and ``different-objects``.

The rules of `projections.fold.objects` hold, and besides:

4.  The commands name detections, by det_id. Those that are the same by command make a *group*. As
    soon as two of a group belong to Objects, these are one: the one founded first survives, with
    the sums over the observations of both. It is found as an Object of all its members' classes.
5.  Objects with detections that are kept apart by command *conflict*; they are never merged. An
    observation that the commands name fuses with the best candidate that conflicts with neither its
    group nor the Object that its group has; without one it joins that Object, however far and
    unlike it is, or founds a new one.

So both are obeyed exactly. An observation that has no embedding of the map's space or no pose is of
no Object, whatever a command says of it.
"""

from eventsrc.envelope.model import DetId, Offset

from . import State
from .deltas import ObjectFound, ObjectOrdinal, ObjectSeen, ObjectsMerged
from .exact import MAX_IN_A_SUM
from .objects import FusibleObservation, Objects
from .pair_groups import PairGroups


class ConstrainedObjects(Objects):
    """The reducer under pairs of det_ids."""

    def __init__(
        self, fusion_radius_m: float, fusion_similarity: float, groups: PairGroups[DetId]
    ) -> None:
        super().__init__(fusion_radius_m, fusion_similarity)
        self._groups = groups
        self._object_of: dict[int, ObjectOrdinal] = {}  # group → its Object
        self._inside: dict[ObjectOrdinal, set[int]] = {}  # Object → the groups in it
        self._absorbed: set[ObjectOrdinal] = set()

    def fold_named(
        self,
        offset: Offset,
        seen: FusibleObservation,
        timestamp: float,
        x_um: int,
        y_um: int,
    ) -> list[ObjectFound | ObjectSeen | ObjectsMerged]:
        """Fuse one observation, as `Objects.fold`; an ObjectsMerged comes last."""
        _, det_id, class_name, *_ = seen
        group = self._groups.group_of.get(det_id)
        if group is None:
            return [*self.fold(offset, seen, timestamp, x_um, y_um)]
        own = self._object_of.get(group)
        inside = {group} if own is None else self._inside[own]
        free = [
            candidate
            for candidate in self.candidates_at(class_name, x_um, y_um)
            if candidate == own
            or not self._groups.conflicts(inside, self._inside.get(candidate, ()))
        ]
        fused = self.fold(offset, seen, timestamp, x_um, y_um, free, own)
        deltas: list[ObjectFound | ObjectSeen | ObjectsMerged] = [*fused]
        ordinal = fused[-1].object
        self._add_class(ordinal, class_name)
        self._inside.setdefault(ordinal, set()).add(group)
        self._object_of.setdefault(group, ordinal)
        if own is not None and ordinal != own:
            deltas.append(self._merge(offset, min(own, ordinal), max(own, ordinal)))
        return deltas

    def dump(self) -> State:
        """The whole state, for a snapshot."""
        return super().dump() | {
            "other_classes": [[*o.other_classes] for o in self.sums],
            "object_of": sorted(map(list, self._object_of.items())),
            "absorbed": sorted(self._absorbed),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        super().load(state)
        for index, classes in enumerate(state["other_classes"]):
            for class_name in classes:
                self._add_class(ObjectOrdinal(index), class_name)
        for ordinal in state["absorbed"]:
            self._absorbed.add(ordinal)
            self._unlist(ordinal, self.sums[ordinal])
        for group, ordinal in state["object_of"]:
            self._object_of[group] = ordinal
            self._inside.setdefault(ordinal, set()).add(group)

    def _merge(
        self, offset: Offset, survivor: ObjectOrdinal, absorbed: ObjectOrdinal
    ) -> ObjectsMerged:
        sums, other = self.sums[survivor], self.sums[absorbed]
        if sums.count + other.count > MAX_IN_A_SUM:
            raise OverflowError(
                f"objects {survivor} and {absorbed} have more than {MAX_IN_A_SUM} observations "
                "together, the bound of exact arithmetic"
            )
        self._unlist(survivor, sums)
        self._unlist(absorbed, other)
        self._absorbed.add(absorbed)
        sums.vector_sum += other.vector_sum
        sums.norm2 = sum(component**2 for component in map(int, sums.vector_sum.tolist()))
        sums.count += other.count
        sums.sum_x_um += other.sum_x_um
        sums.sum_y_um += other.sum_y_um
        sums.first_seen = min(sums.first_seen, other.first_seen)
        sums.last_seen = max(sums.last_seen, other.last_seen)
        side = self._radius_um * sums.count
        sums.column, sums.row = sums.sum_x_um // side, sums.sum_y_um // side
        classes = (*sums.other_classes, other.class_name, *other.other_classes)
        sums.other_classes = tuple(c for c in dict.fromkeys(classes) if c != sums.class_name)
        self._list(survivor, sums)
        moved = self._inside.pop(absorbed, set())
        self._inside.setdefault(survivor, set()).update(moved)
        self._object_of |= dict.fromkeys(moved, survivor)
        return ObjectsMerged(
            offset,
            survivor,
            absorbed,
            sums.count,
            sums.sum_x_um,
            sums.sum_y_um,
            sums.first_seen,
            sums.last_seen,
        )

    def _add_class(self, ordinal: ObjectOrdinal, class_name: str) -> None:
        """Add a class of which the Object has a member."""
        sums = self.sums[ordinal]
        if class_name not in (sums.class_name, *sums.other_classes):
            self._unlist(ordinal, sums)
            sums.other_classes += (class_name,)
            self._list(ordinal, sums)
