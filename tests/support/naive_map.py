"""The whole fold once more, as slow and plain as can be: an oracle for `SemanticMap`.

It shares no code with what it checks: it reads JSON documents, not validated envelopes; it computes
in fractions and Python integers; after every keyframe it counts everything again. Only the rules
are the same (docstrings in `projections.fold`), and the text of `projections.map.digest`,
which it writes by itself.

The map of a log under corrections, as slow and plain as can be: `naive_map` of corrected
events, with naive rules for what is one and what is kept apart.
"""

import base64
import hashlib
import json
import math
import struct
import zlib
from collections import Counter
from fractions import Fraction
from itertools import pairwise
from typing import Any

from projections.fold.corrections import Corrections
from tests.support.naive_places import NaiveConstrainedPlaces, NaiveRooms

from .folds import NaivePlaces, near_matrix

Q40 = 2**40

Posed = tuple[int, int, float]


def micrometres(metres: float) -> int:
    """The nearest micrometre, ties to even."""
    return round(Fraction(metres) * 1_000_000)


def unit_vector(raw: bytes) -> list[int]:
    """Multiples of 2⁻²⁰ in the direction of little-endian float32 values, at most 4,096 of them."""
    values = struct.unpack(f"<{len(raw) // 4}f", raw)
    shift = 20 - math.frexp(max(map(abs, values)))[1]
    whole = [round(Fraction(value) * Fraction(2) ** shift) for value in values]
    scale = 2**20 / math.sqrt(sum(v * v for v in whole))
    return [round(v * scale) for v in whole]


def cosine_q40(members: list[list[int]], unit: list[int]) -> int:
    """The cosine of the members' sum and a unit vector."""
    total = [sum(column) for column in zip(*members, strict=True)]
    dot = sum(a * b for a, b in zip(total, unit, strict=True))
    squares = sum(a * a for a in total) * sum(a * a for a in unit)
    return round(dot / math.sqrt(squares) * Q40) if squares else 0


class NaiveMap:
    """Feed it documents; ask for the map's digest and what was left out."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings
        self.space = None, settings.get("embedding_dim")
        self.is_space_decided = False
        self.runs: dict[str, list[float]] = {}
        self.keyframes: list[dict[str, Any]] = []
        self.observations: list[dict[str, Any]] = []
        self.objects: list[list[dict[str, Any]]] = []
        self.places: NaivePlaces | NaiveRooms = NaivePlaces(settings["min_samples"])
        if settings.get("places") == "rooms":
            constants = settings["rooms"]["cell_m"], settings["rooms"]["drive_m"]
            self.places = NaiveRooms(*map(micrometres, constants))
        self.left_out: Counter[str] = Counter()

    def fold(self, document: dict[str, Any]) -> None:
        """Take in one envelope."""
        run, number = document["run_id"], document["keyframe_id"]
        said = _content(document)
        for old in self.keyframes:
            if (old["run"], old["number"]) == (run, number):
                self.left_out["duplicate" if old["said"] == said else "conflict"] += 1
                return
        self.runs.setdefault(run, []).append(document["timestamp"])
        pose = None
        if document.get("map_x") is not None:
            pose = (micrometres(document["map_x"]), micrometres(document["map_y"]))
        keyframe = {
            "run": run,
            "number": number,
            "said": said,
            "time": document["timestamp"],
            "pose": pose,
            "yaw": document.get("map_yaw"),
        }
        self.keyframes.append(keyframe)
        self._cluster(pose)
        for detection in said[1]:
            self._observe(keyframe, *detection)

    def _cluster(self, pose: tuple[int, int] | None) -> None:
        if pose is None:
            return
        if isinstance(self.places, NaiveRooms):
            self.places.add(self.keyframes[-1]["run"], *pose)
            return
        points = [(*k["pose"], k["yaw"]) for k in self.keyframes if k["pose"] is not None]
        near = near_matrix(len(points), lambda i, j: self.is_within_eps(points[i], points[j]))
        self.places.add(near)

    def is_within_eps(self, a: Posed, b: Posed) -> bool:
        eps = micrometres(self.settings["eps_m"])
        return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= eps**2

    def _observe(
        self, keyframe: dict[str, Any], det_id: str, name: str, model: Any, raw: Any, rest: Any
    ) -> None:
        is_member = raw is not None and self._is_of_space(model, len(raw) // 4)
        if any(o["det_id"] == det_id for o in self.observations):
            self.left_out["det_id_reused"] += 1
            return
        observation = {
            "keyframe": keyframe,
            "det_id": det_id,
            "class": name,
            "rest": rest,
            "model": model,
            "unit": unit_vector(raw) if is_member else None,
            "foreign": raw is not None and not is_member,
            "object": None,
            "q40": None,
        }
        self.observations.append(observation)
        if is_member and keyframe["pose"] is not None:
            self._fuse(observation)

    def _is_of_space(self, model: Any, dim: int) -> bool:
        if not self.is_space_decided and self.space[1] in (None, dim):
            self.space, self.is_space_decided = (model, dim), True
        return self.is_space_decided and self.space == (model, dim)

    def _fuse(self, observation: dict[str, Any]) -> None:
        x, y = observation["keyframe"]["pose"]
        radius = micrometres(self.settings["fusion_radius_m"])
        found = []
        for ordinal, members in enumerate(self.objects):
            mean_x, mean_y = (Fraction(s, len(members)) for s in _sums(members))
            is_close = (mean_x - x) ** 2 + (mean_y - y) ** 2 <= radius**2
            if is_close and members[0]["class"] == observation["class"]:
                q40 = cosine_q40([m["unit"] for m in members], observation["unit"])
                if q40 >= Fraction(self.settings["fusion_similarity"]) * Q40:
                    found.append((-q40, ordinal))
        if found:
            observation["q40"], observation["object"] = -min(found)[0], min(found)[1]
            self.objects[observation["object"]].append(observation)
        else:
            observation["q40"], observation["object"] = Q40, len(self.objects)
            self.objects.append([observation])

    def _labels(self) -> list[int | None]:
        """Each keyframe's place."""
        coming = iter(self.places.labels)
        return [None if k["pose"] is None else next(coming) for k in self.keyframes]

    def digest(self) -> str:
        """What `projections.map.digest.map_digest` must say."""
        labels = self._labels()
        sections = {
            "runs": [(run, min(times)) for run, times in self.runs.items()],
            "keyframes": self._keyframe_rows(labels),
            "observations": self._observation_rows(),
            "objects": self._object_rows(labels),
            "places": self._place_rows(labels),
            "adjacency": self._adjacency_rows(labels),
        } | self._more_sections(labels)
        text = "mapfold map 1\n"
        for name, rows in sections.items():
            text += f"{name}\n" + "".join(
                json.dumps(row, separators=(",", ":")) + "\n" for row in rows
            )
        return hashlib.sha256(text.encode()).hexdigest()

    def _more_sections(self, labels: list[int | None]) -> dict[str, list[Any]]:
        return {}

    def _keyframe_rows(self, labels: list[int | None]) -> list[Any]:
        runs = list(self.runs)
        return [
            (
                runs.index(k["run"]),
                k["number"],
                k["time"],
                None if k["pose"] is None else (*k["pose"], k["yaw"]),
                label,
            )
            for k, label in zip(self.keyframes, labels, strict=True)
        ]

    def _observation_rows(self) -> list[Any]:
        rows = []
        for o in self.observations:
            unit = o["unit"]
            crc = None if unit is None else zlib.crc32(struct.pack(f"<{len(unit)}i", *unit))
            seen = (self.keyframes.index(o["keyframe"]), o["det_id"], o["class"], *o["rest"])
            rows.append((*seen, o["model"], crc, o["foreign"], o["object"], o["q40"]))
        return rows

    def _object_rows(self, labels: list[int | None]) -> list[Any]:
        rows = []
        for members in self.objects:
            first, times = members[0], [m["keyframe"]["time"] for m in members]
            named = "obj-" + hashlib.sha256(first["det_id"].encode()).hexdigest()[:16]
            votes = Counter(labels[self.keyframes.index(m["keyframe"])] for m in members)
            del votes[None]
            place = min(votes, key=lambda p: (-votes[p], p)) if votes else None
            sums = _sums(members)
            row = (named, first["class"], len(members), *sums, min(times), max(times), place)
            rows.append(row)
        return rows

    def _place_rows(self, labels: list[int | None]) -> list[Any]:
        posed = [i for i, k in enumerate(self.keyframes) if k["pose"] is not None]
        counters: Counter[str] = Counter()
        rows = []
        for place, founder in enumerate(posed[point] for point in self.places.founders):
            run = self.keyframes[founder]["run"]
            members = [{"keyframe": self.keyframes[i]} for i in posed if labels[i] == place]
            if members:
                row = (place, f"{run}_p{counters[run]}", founder, len(members), *_sums(members))
                rows.append(row)
            counters[run] += 1
        return rows

    def _adjacency_rows(self, labels: list[int | None]) -> list[Any]:
        counted: Counter[tuple[int, int]] = Counter()
        for run in self.runs:
            placed = sorted(
                (k["number"], label)
                for k, label in zip(self.keyframes, labels, strict=True)
                if k["run"] == run and label is not None
            )
            for (_, a), (_, b) in pairwise(placed):
                if a != b:
                    counted[min(a, b), max(a, b)] += 1
        return [(a, b, n) for (a, b), n in sorted(counted.items())]


def _sums(members: list[dict[str, Any]]) -> tuple[int, int]:
    poses = [m["keyframe"]["pose"] for m in members]
    return sum(x for x, _ in poses), sum(y for _, y in poses)


def _content(document: dict[str, Any]) -> tuple[Any, list[tuple[Any, ...]]]:
    """What an envelope says, however it is written, and its detections one by one."""
    head = [document.get(name) for name in ("timestamp", "map_x", "map_y", "map_yaw")]
    seen = []
    for index, d in enumerate(document["detections"]):
        by_default = f"{document['run_id']}_kf{document['keyframe_id']}_d{index}"
        raw = base64.b64decode(d["embedding"]) if "embedding" in d else None
        rest = (d["confidence"], tuple(d["bbox"]))
        det_id = d.get("det_id", by_default)
        seen.append((det_id, d["class"], d.get("embedding_model"), raw, rest))
    return head, seen


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
    labels = corrections.labels
    detections = [{**d, "class": labels.get(d["class"], d["class"])} for d in detections]
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
