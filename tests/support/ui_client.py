"""A slow, obvious client of the web debugger: it reads the arrays and replays them row by row."""

import json
import math
import struct
from dataclasses import dataclass, field
from typing import Any

_CODES = {"i8": "q", "f8": "d", "f4": "f", "i4": "i", "u4": "I", "u1": "B"}


def read_arrays(answer: bytes) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The header and the arrays of ``/api/history``, by the description in docs/ui.md."""
    (length,) = struct.unpack_from("<I", answer)
    header = json.loads(answer[4 : 4 + length])
    arrays, end = {}, 4 + length
    for each in header["arrays"]:
        assert each["offset"] % 8 == 0
        assert set(answer[end : each["offset"]]) <= {0}  # nothing but padding in between
        code = f"<{each['length']}{_CODES[each['dtype']]}"
        arrays[each["name"]] = list(struct.unpack_from(code, answer, each["offset"]))
        end = each["offset"] + struct.calcsize(code)
    return header, arrays


def as_float32(value: float) -> float:
    """The nearest float32."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


@dataclass
class ReplayedMap:
    """The map at W as a page sees it."""

    keyframes: list[tuple[str, int, int | None]] = field(default_factory=list)
    """Run, id, and the place's number."""
    poses: list[tuple[float, float, float] | None] = field(default_factory=list)
    places: dict[int, list[int]] = field(default_factory=dict)
    """Members by place."""
    place_ids: dict[int, str] = field(default_factory=dict)
    names: dict[int, str] = field(default_factory=dict)
    objects: dict[int, dict[str, Any]] = field(default_factory=dict)
    adjacency: dict[tuple[int, int], int] = field(default_factory=dict)


def replay(header: dict[str, Any], arrays: dict[str, list[Any]], end: int) -> ReplayedMap:
    """Apply every row below ``end``, in the order of offsets."""
    found = ReplayedMap()
    place_of: dict[int, int] = {}
    survivor: dict[int, int] = {}
    object_gone: set[int] = set()
    rows: list[tuple[int, int, str, int]] = []
    for order, prefix in enumerate(("kf", "pf", "pl", "mg", "of", "oc", "om", "ad")):
        offsets = arrays[f"{prefix}_offset"]
        assert offsets == sorted(offsets), prefix
        rows += [(offset, order, prefix, index) for index, offset in enumerate(offsets)]
    strings = header["strings"]
    for offset, _, prefix, i in sorted(rows):
        if offset >= end:
            break
        row = {
            name.removeprefix(f"{prefix}_"): values[i]
            for name, values in arrays.items()
            if name.startswith(f"{prefix}_")
        }
        if prefix == "kf":
            found.keyframes.append((strings["run_id"][row["run"]], row["number"], None))
            x, y, yaw = row["x"], row["y"], row["yaw"]
            found.poses.append(None if math.isnan(x) else (x, y, yaw))
        elif prefix == "pf":
            found.place_ids[row["place"]] = strings["place_id"][row["place"]]
        elif prefix == "pl":
            place_of[row["keyframe"]] = row["place"]
        elif prefix == "mg":
            survivor[row["absorbed"]] = row["survivor"]
        elif prefix == "of":
            found.objects[row["object"]] = {"id": strings["object_id"][row["object"]]}
        elif prefix == "oc":
            found.objects[row["object"]].update(
                x=row["x"], y=row["y"], xx=row["xx"], xy=row["xy"], yy=row["yy"],
                count=row["count"], class_name=strings["class"][row["class"]],
                place=None if row["place"] < 0 else row["place"], missing=bool(row["missing"]),
            )  # fmt: skip
        elif prefix == "om":
            object_gone.add(row["absorbed"])
        elif row["count"]:
            found.adjacency[row["a"], row["b"]] = row["count"]
        else:
            found.adjacency.pop((row["a"], row["b"]), None)
    for keyframe, place in place_of.items():
        while place in survivor:
            place = survivor[place]
        run, number, _ = found.keyframes[keyframe]
        found.keyframes[keyframe] = run, number, place
        found.places.setdefault(place, []).append(keyframe)
    for named in header["names"]:
        if named["offset"] < end:
            found.names[named["place"]] = named["name"]
    found.names = {
        p: name for p, name in found.names.items() if name is not None and p not in survivor
    }
    found.objects = {o: v for o, v in found.objects.items() if o not in object_gone}
    found.place_ids = {p: v for p, v in found.place_ids.items() if p not in survivor}
    for members in found.places.values():
        members.sort()
    return found
