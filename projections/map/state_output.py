"""Output of ``mapfold state``: the map as a JSON document or as text, and advice on settings where
all poses are in one place or hardly any is in one, no vector is of the space that they name, or
nothing states the camera."""

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any, Final

from eventsrc.base.text import advised, command_line, counted, shortening, table, visible
from eventsrc.envelope.model import Offset
from projections.fold.deltas import MapGiven, PlaceOrdinal
from projections.fold.exact import UM_PER_M
from projections.fold.place_types import PlaceType
from projections.fold.settings import Settings, assignment_texts

from .frames import frames_line, frames_of
from .naming import ShortIds, things_of
from .phrases import command_document, seen_times
from .place_regions import place_regions
from .records import ObjectRecord, body_fields, objects_text
from .view import MapView


def state_document(
    view: MapView, digest: str | None, known_at: Offset | None = None
) -> dict[str, Any]:
    """The JSON document. Every list is ordered by ordinal. ``digest`` may be left out.

    ``known_at`` is the point before which commands were known, by default the map's own.
    """
    return {
        "offset": view.next_offset,
        "settings": view.settings.model_dump(),
        "digest": digest,
        "counts": view.counts(),
        "keyframes": _keyframes(view),
        "places": _places(view),
        "objects": _objects(view),
        "adjacency": [
            {"a": view.place_id(a), "b": view.place_id(b), "shared_transitions": transitions}
            | ({"between_floors": True} if view.is_between_floors(a, b) else {})
            for a, b, transitions in view.edges()
        ],
        **({"floors": list(view.floors)} if view.floors else {}),
        **({"frames": [each.document() for each in frames]} if (frames := frames_of(view)) else {}),
        **_map(view),
        **_corrections(view, known_at),
    }


def _map(view: MapView) -> dict[str, Any]:
    """The occupancy map in force on the first floor, and where maps name floors all of them;
    nothing where there is none."""
    first = view.map
    named = any(floor is not None for floor in view.maps)
    return {
        **({} if first is None else {"map": _given(first)}),
        **({"maps": [_given(each) for each in view.maps_in_force().values()]} if named else {}),
    }


def _given(delta: MapGiven) -> dict[str, Any]:
    given = delta.map
    return {
        "offset": delta.offset,
        "map_id": given.map_id,
        "source": given.source,
        "resolution": given.resolution,
        "origin": list(given.origin),
        "width": given.width,
        "height": given.height,
        "digest": given.digest(),
        **_floor(given.floor),
    }


def _corrections(view: MapView, known_at: Offset | None) -> dict[str, Any]:
    """The commands in force; nothing where there are none."""
    corrections = view.corrections
    if not corrections.in_force:
        return {}
    return {
        "corrections": {
            "known_at": view.next_offset if known_at is None else known_at,
            "fingerprint": corrections.fingerprint(),
            "commands": [command_document(recorded) for recorded in corrections.in_force],
        }
    }


def _keyframes(view: MapView) -> list[dict[str, Any]]:
    return [
        {
            "run_id": k.run_id,
            "keyframe_id": k.keyframe_id,
            "map_x": None if k.pose is None else k.pose.x_m,
            "map_y": None if k.pose is None else k.pose.y_m,
            "map_yaw": None if k.pose is None else k.pose.yaw_rad,
            "place_id": view.place_id(k.place),
            **_floor(k.floor),
        }
        for k in view.keyframes
    ]


def _places(view: MapView) -> list[dict[str, Any]]:
    regions = place_regions(view)
    return [
        {
            "place_id": p.place_id,
            "centroid_x": p.centroid_x,
            "centroid_y": p.centroid_y,
            "keyframe_count": p.keyframe_count,
            **({} if p.name is None else {"name": p.name}),
            **_floor(view.floor_of(p.ordinal)),
            **_type(view.type_of(p.ordinal)),
            **(regions[p.ordinal].document() if p.ordinal in regions else {}),
        }
        for p in view.places.values()
    ]


def _floor(name: str | None) -> dict[str, str]:
    """The floor's name, where the log has it."""
    return {} if name is None else {"floor": name}


def _type(found: PlaceType | None) -> dict[str, Any]:
    """The type of room; None where unsure. Nothing where no Object of a known class is in it."""
    if found is None:
        return {}
    return {
        "type": found.type,
        "type_probability": found.probability,
        "type_candidates": [{"type": t, "probability": p} for t, p in found.candidates],
    }


def _objects(view: MapView) -> list[dict[str, Any]]:
    det_ids = view.det_ids()
    return [
        {
            "object_id": o.object_id,
            "class_name": o.class_name,
            "mean_x": o.mean_x,
            "mean_y": o.mean_y,
            "obs_count": o.obs_count,
            "place_id": view.place_id(o.place),
            **seen_times(o.first_seen, o.last_seen),
            "det_ids": [det_ids[i] for i in o.observations],
            "confirmed": o.confirmed,
            **body_fields(view.body_of(o)),
            **(_evidence(view, o) if view.settings.fusion == "evidence" else {}),
        }
        for o in view.objects.values()
    ]


def _evidence(view: MapView, found: ObjectRecord) -> dict[str, Any]:
    """Facts of fusion by evidence about an Object."""
    at = found.estimate
    return {
        "est_x": None if at is None else at.est_x,
        "est_y": None if at is None else at.est_y,
        "est_sigma_m": None if at is None else at.est_sigma_m,
        "spots": None if at is None else at.spots,
        "class_counts": view.class_counts(found),
        "missing": found.missing_in is not None,
        "relocations": [
            {
                "offset": r.offset,
                "from": [r.from_x_um / UM_PER_M, r.from_y_um / UM_PER_M],
                "to": [r.to_x_um / UM_PER_M, r.to_y_um / UM_PER_M],
            }
            for r in found.relocations
        ],
    }


_MAX_PLACES = 40


def state_text(
    view: MapView,
    digest: str | None,
    known_at: Offset | None = None,
    *,
    everything: bool = False,
) -> str:
    """Counts, settings, digest and the first 40 places, for people; ends in a newline. Objects seen
    once are counted in the places only with ``everything``."""
    lines = [
        f"after {counted(view.next_offset, 'event')}: {_counts(view)}",
        f"settings {_settings(view.settings)}",
        *([] if digest is None else [f"digest   {digest}"]),
    ]
    if view.settings.fusion == "evidence":
        lines.append(f"objects  {_standing(view)}")
    lines += [_walls(floor, given, view) for floor, given in view.maps_in_force().items()]
    if frames := frames_of(view):
        lines.append(f"frames   {frames_line(frames)}")
    if in_force := view.corrections.in_force:
        known = view.next_offset if known_at is None else known_at
        lines.append(f"commands {len(in_force):,} in force, of those before {known:,}")
    with shortening(ShortIds.of(things_of(view)).text):
        lines += _place_lines(view, everything=everything)
    return "\n".join(lines) + "\n"


def _walls(floor: str | None, delta: MapGiven, view: MapView) -> str:
    given = delta.map
    size = f"{given.width:,} × {given.height:,} cells of {given.resolution:g} m"
    where = "" if floor is None else f" of floor {visible(floor)}"
    line = f"walls    {size}{where}, from {given.source} at offset {delta.offset:,}"
    if view.settings.places == "rooms":
        return line
    return f"{line}; places=page does not use them for places, --preset full does"


def _standing(view: MapView) -> str:
    """``12 seen from two spots or more (median standard error 0.14 m), 3 from one, 1 missing``."""
    found = view.objects.values()
    seen = [o.estimate for o in found if o.estimate is not None and o.estimate.spots > 1]
    error = f" (median standard error {median(e.est_sigma_m for e in seen):.2f} m)" if seen else ""
    rest = {
        "missing": sum(o.missing_in is not None for o in found),
        "moved": sum(bool(o.relocations) for o in found),
    }
    more = "".join(f", {count:,} {word}" for word, count in rest.items() if count)
    once = len(found) - len(seen)
    return f"{len(seen):,} seen from two spots or more{error}, {once:,} from one{more}"


def _counts(view: MapView) -> str:
    counts = view.counts()
    words = ("run", "keyframe", "observation")
    parts = [counted(counts[f"{word}s"], word) for word in words]
    parts += [objects_text(view.objects.values()), counted(counts["places"], "place")]
    text = ", ".join(parts)
    rare = {
        "noise": "{} in no place",
        "duplicates": "{} seen twice",
        "conflicts": "{} with other content ignored",
        "det_ids_reused": "{} left out for a det_id used before",
        "foreign_embeddings": "{} of another embedding space",
        "forgotten": "{} forgotten",
        "dropped": "{} dropped",
        "scan_too_far": "{} left out, too far from the first",
    }
    things = {
        "det_ids_reused": "observation",
        "foreign_embeddings": "observation",
        "dropped": "detection",
        "scan_too_far": "scan",
    }
    for key, phrase in rare.items():
        if counts.get(key):
            text += ", " + phrase.format(counted(counts[key], things.get(key, "keyframe")))
    return text


def _settings(settings: Settings) -> str:
    changed = settings.changed_from(Settings())
    shown = changed or {k: v for k, v in Settings().model_dump().items() if v is not None}
    text = ", ".join(assignment_texts(shown))
    return text if changed else f"default: {text}"


def _shown_type(found: PlaceType | None) -> str:
    """``kitchen 87 %``; empty where unsure, or where the name says it."""
    if found is None or found.type is None or found.named:
        return ""
    return f"{found.type} {found.probability:.0%}".replace("%", " %")


def _shown_floor(name: str | None) -> str:
    return "-" if name is None else visible(name)


def _place_lines(view: MapView, *, everything: bool) -> list[str]:
    if not view.places:
        return ["no places yet"]
    neighbours: dict[PlaceOrdinal, list[str]] = {place: [] for place in view.places}
    for a, b, transitions in view.edges():
        neighbours[a].append(f"{view.place_id(b)} ×{transitions}")
        neighbours[b].append(f"{view.place_id(a)} ×{transitions}")
    objects = dict.fromkeys(view.places, 0)
    for record in view.objects.values():
        if record.place is not None and (everything or record.confirmed):
            objects[record.place] += 1
    shown = list(view.places.items())[:_MAX_PLACES]
    columns: dict[str, list[str]] = {"place": [place.place_id for _, place in shown]}
    if any(place.name is not None for _, place in shown):
        columns["name"] = [place.name or "" for _, place in shown]
    if view.floors:
        columns["floor"] = [_shown_floor(view.floor_of(ordinal)) for ordinal, _ in shown]
    if any(types := [_shown_type(view.type_of(ordinal)) for ordinal, _ in shown]):
        columns["type"] = types
    columns |= {
        "keyframes": [str(place.keyframe_count) for _, place in shown],
        "objects": [str(objects[ordinal]) for ordinal, _ in shown],
        "centroid (m)": [f"({p.centroid_x:.2f}, {p.centroid_y:.2f})" for _, p in shown],
        "next to": [", ".join(neighbours[ordinal]) for ordinal, _ in shown],
    }
    rows = zip(*columns.values(), strict=True)
    lines = table([*columns], rows, right=("keyframes", "objects")).rstrip("\n").split("\n")
    if len(view.places) > _MAX_PLACES:
        lines.append(f"… and {len(view.places) - _MAX_PLACES} more places; --json lists all")
    return lines


LEAST_POSES: Final = 20
"""The least number of posed keyframes for which advice is given."""
_MOSTLY: Final = 0.8


def space_advice(view: MapView) -> str | None:
    """One line where detections are not fused: they have no vector and the rule needs one, or the
    settings name a space of which the map has none."""
    model = view.settings.embedding_model
    if view.all_objects and view.settings.fusion != "evidence":
        bare = sum(each.embedding_crc is None for each in view.observations)
        of = f"{bare:,} of {counted(len(view.observations), 'detection')}"
        told = f"{of} have no embedding and are of no Object; --preset full needs none"
        return told if bare else None
    if not view.observations or view.all_objects:
        return None
    if model is None:
        by_evidence = view.settings.fusion == "evidence"
        if by_evidence or any(o.embedding_crc is not None for o in view.observations):
            return None
        return "no detection has an embedding, so there are no Objects; --preset full needs none"
    if any(o.embedding_crc is not None and not o.foreign_space for o in view.observations):
        return None
    return (
        f"no detection has a vector of space {visible(model)}, so there are no Objects; the log's"
        f" spaces: `{visible(advised('log', 'spaces'))}`"
    )


def camera_advice(where: str, settings: Settings, log: Path) -> str:
    """One line on a camera that is not stated ``where`` ("for 12 keyframes"), and what to do."""
    camera = settings.camera.constants
    return (
        f"no camera is stated {where}, so boxes are read as if of {camera.hfov_deg:g}° and"
        f" {camera.width_px:g} × {camera.height_px:g} pixels:"
        f" `{visible(state_camera(log))}` states it;"
        f" `{visible(advised('calibrate', log))}` says whether the map's revisits can estimate it"
    )


def state_camera(log: Path) -> str:
    """The command that states the camera of a log's pictures."""
    given = [f"--set camera.{name}=…" for name in ("hfov_deg", "width_px", "height_px")]
    return " ".join([command_line("edit", log, "use-settings"), *given, "--reason WHY"])


def places_advice(counts: Mapping[str, int], settings: Settings) -> str | None:
    """One line that names the setting that helps; None where nothing stands out. ``counts`` are
    those of `MapView.counts`."""
    posed, noise, places = counts["poses"], counts["noise"], counts["places"]
    if posed < LEAST_POSES:
        return None
    if noise >= _MOSTLY * posed:
        return (
            f"{noise:,} of {counted(posed, 'keyframe')} with a pose are in no place; --preset full"
            " puts each into one"
        )
    if places != 1:
        return None
    but = f" but {noise:,}" if noise else ""
    found = f"all {counted(posed, 'keyframe')} with a pose{but} are in one place"
    if settings.places == "rooms":
        return (
            f"{found}; if that is more than one room, a smaller rooms.drive_m than"
            f" {settings.rooms.drive_m:g} tells them apart"
        )
    return f"{found}; if that is more than one room, --preset full tells them apart"
