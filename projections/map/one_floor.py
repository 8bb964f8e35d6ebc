"""The part of a map that is on one floor, as a view to draw."""

from msgspec.structs import replace

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible

from .view import MapView

UNNAMED = "-"
"""The value of `--floor` for the floor of poses whose envelopes name none."""


def view_of_floor(view: MapView, floor: str) -> MapView:
    """A view of the places, Objects and poses on a floor. Keyframes elsewhere are in it without
    their pose, so all ordinals hold. Raises MisuseError for a floor that is not in the map."""
    name = None if floor == UNNAMED and UNNAMED not in view.floors else floor
    posed = [k for k in view.keyframes if k.pose is not None]
    if all(k.floor != name for k in posed):
        unnamed = [UNNAMED] if any(k.floor is None for k in posed) else []
        known = ", ".join(map(visible, [*view.floors, *unnamed])) or "no floor"
        raise MisuseError(f"no floor {floor!r} in this map; it has {known}")
    found = MapView(view.settings, keep_embeddings=False, corrections=view.corrections)
    found.advance(view.next_offset)
    found.runs, found.observations = view.runs, view.observations
    found.keyframes = [k if k.floor == name else replace(k, pose=None) for k in view.keyframes]
    found.all_places, found.survivors = view.all_places, view.survivors
    found.places = {p: each for p, each in view.places.items() if view.floor_of(p) == name}
    found.all_objects, found.object_survivors = view.all_objects, view.object_survivors
    found.objects = {
        number: each
        for number, each in view.objects.items()
        if view.keyframes[view.observations[each.observations[0]].keyframe].floor == name
    }
    found.adjacency = {
        (a, b): count
        for (a, b), count in view.adjacency.items()
        if a in found.places and b in found.places
    }
    if (given := view.maps_in_force().get(name)) is not None:
        found.maps[None] = given  # the only floor is the first
    found.floors, found.contents = view.floors, view.contents
    return found
