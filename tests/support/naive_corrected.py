"""The map of a log under corrections, as slow and plain as can be: `naive_map` of corrected
events, with naive rules for what is one and what is kept apart."""

import math
from fractions import Fraction
from typing import Any

from projections.fold.corrections import Corrections

from .naive_constrained import NaiveConstrainedPlaces
from .naive_map import NaiveMap, cosine_q40, micrometres

Q40 = 2**40


def corrected(document: dict[str, Any], corrections: Corrections) -> dict[str, Any] | None:
    """An envelope with the corrections written in; None if it is forgotten."""
    run, number = document["run_id"], document["keyframe_id"]
    if run in corrections.forgotten_runs:
        return None
    for first, last in corrections.forgotten_ranges.get(run, ()):
        if first <= number <= last:
            return None
    pose = tuple(document.get(name) for name in ("map_x", "map_y", "map_yaw"))
    for each in corrections.poses.get(run, ()):
        if each.transform is None:
            pose = each.poses.get(number, pose)
        elif pose[0] is not None:
            t, (x, y, yaw) = each.transform, pose
            if (each.first is None or number >= each.first) and (
                each.last is None or number <= each.last
            ):
                pose = t.cos * x - t.sin * y + t.dx, t.sin * x + t.cos * y + t.dy, yaw + t.dyaw
    detections = [
        {"det_id": f"{run}_kf{number}_d{index}"} | detection
        for index, detection in enumerate(document["detections"])
    ]
    detections = [d for d in detections if d["det_id"] not in corrections.dropped]
    written = dict(zip(("map_x", "map_y", "map_yaw"), pose, strict=True))
    return {**document, **written, "detections": detections}


class NaiveCorrectedMap(NaiveMap):
    """Feed it documents as they were recorded."""

    def __init__(self, settings: dict[str, Any], corrections: Corrections) -> None:
        super().__init__(settings)
        self.corrections = corrections
        side = math.isqrt(micrometres(settings["eps_m"]) ** 2 // 2) + 1
        self.places = NaiveConstrainedPlaces(
            settings["min_samples"],
            lambda point: tuple(v // side for v in self._posed(point)["pose"]),
            corrections.joined,
            corrections.apart,
            lambda point: (self._posed(point)["run"], self._posed(point)["number"]),
        )
        self.same_as: dict[str, set[str]] = {}
        for pair in (*corrections.same, *corrections.different):
            for det_id in pair:
                self.same_as.setdefault(det_id, {det_id})
        for a, b in corrections.same:
            together = self.same_as[a] | self.same_as[b]
            self.same_as |= dict.fromkeys(together, together)

    def fold(self, document: dict[str, Any]) -> None:
        """Take in one envelope."""
        found = corrected(document, self.corrections)
        if found is None:
            self.left_out["forgotten"] += 1
            return
        before = len(self.keyframes)
        super().fold(found)
        if len(self.keyframes) > before:
            gone = len(document["detections"]) - len(found["detections"])
            self.left_out["dropped"] += gone

    def _posed(self, point: int) -> dict[str, Any]:
        return [k for k in self.keyframes if k["pose"] is not None][point]

    def _ids(self, members: list[dict[str, Any]]) -> set[str]:
        """Det_ids of members, and those that are the same by command."""
        return {x for m in members for x in self.same_as.get(m["det_id"], {m["det_id"]})}

    def _conflict(self, one: set[str], other: set[str]) -> bool:
        return any(
            (self.same_as[a] & one and self.same_as[b] & other)
            or (self.same_as[b] & one and self.same_as[a] & other)
            for a, b in self.corrections.different
        )

    def _fuse(self, observation: dict[str, Any]) -> None:
        x, y = observation["keyframe"]["pose"]
        radius = micrometres(self.settings["fusion_radius_m"])
        group = self.same_as.get(observation["det_id"], set())
        own = next((i for i, ms in enumerate(self.objects) if ms and group & self._ids(ms)), None)
        inside = group if own is None else self._ids(self.objects[own])
        found = []
        for ordinal, members in enumerate(self.objects):
            if not members or observation["class"] not in {m["class"] for m in members}:
                continue
            poses = [m["keyframe"]["pose"] for m in members]
            mean_x, mean_y = (Fraction(sum(p[i] for p in poses), len(poses)) for i in (0, 1))
            is_close = (mean_x - x) ** 2 + (mean_y - y) ** 2 <= radius**2
            if is_close and (ordinal == own or not self._conflict(inside, self._ids(members))):
                q40 = cosine_q40([m["unit"] for m in members], observation["unit"])
                if q40 >= Fraction(self.settings["fusion_similarity"]) * Q40:
                    found.append((-q40, ordinal))
        if found:
            observation["q40"], ordinal = -min(found)[0], min(found)[1]
        elif own is not None:
            units = [m["unit"] for m in self.objects[own]]
            observation["q40"], ordinal = cosine_q40(units, observation["unit"]), own
        else:
            observation["q40"], ordinal = Q40, len(self.objects)
            self.objects.append([])
        self.objects[ordinal].append(observation)
        observation["object"] = ordinal
        if own not in (None, ordinal):
            first, second = sorted((own, ordinal))
            together = self.objects[first] + self.objects[second]
            self.objects[first], self.objects[second] = [], []
            self.objects[first] = [o for o in self.observations if any(o is m for m in together)]
            for member in self.objects[first]:
                member["object"] = first

    def _object_rows(self, labels: list[int | None]) -> list[Any]:
        kept, self.objects = self.objects, [members for members in self.objects if members]
        rows = super()._object_rows(labels)
        self.objects = kept
        return rows

    def _more_sections(self, labels: list[int | None]) -> dict[str, list[Any]]:
        if not self.corrections.fingerprint():
            return {}
        names: dict[int, str] = {}
        for anchor, name, _ in self.corrections.names:
            for keyframe, label in zip(self.keyframes, labels, strict=True):
                is_anchor = (keyframe["run"], keyframe["number"]) == anchor
                if is_anchor and label is not None:
                    names[label] = name
        return {"names": sorted(names.items()), "corrections": [self.corrections.fingerprint()]}
