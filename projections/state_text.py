"""A map in a few lines for people, what ``mapfold state`` prints."""

from eventsrc.words import counted

from .settings import Settings
from .view import MapView

_MOST = 40


def state_text(view: MapView, digest: str) -> str:
    """The text, with a newline at its end."""
    lines = [
        f"after {counted(view.next_offset, 'event')}: {_counts(view)}",
        f"settings {_settings(view.settings)}",
        f"digest   {digest}",
    ]
    lines += _places(view)
    return "\n".join(lines) + "\n"


def _counts(view: MapView) -> str:
    counts = view.counts()
    words = ("run", "keyframe", "observation", "object", "place")
    text = ", ".join(counted(counts[f"{word}s"], word) for word in words)
    rare = {
        "noise": "{} in no place",
        "duplicates": "{} seen twice",
        "conflicts": "{} with other content ignored",
        "det_ids_reused": "{} left out for a det_id used before",
        "foreign_embeddings": "{} of another embedding space",
    }
    things = {"det_ids_reused": "observation", "foreign_embeddings": "observation"}
    for key, told in rare.items():
        if counts[key]:
            text += ", " + told.format(counted(counts[key], things.get(key, "keyframe")))
    return text


def _settings(settings: Settings) -> str:
    default = Settings().model_dump()
    changed = {k: v for k, v in settings.model_dump().items() if v != default[k]}
    shown = changed or {k: v for k, v in default.items() if v is not None}
    text = ", ".join(f"{name}={value}" for name, value in shown.items())
    return text if changed else f"default: {text}"


def _places(view: MapView) -> list[str]:
    if not view.places:
        return ["no places yet"]
    neighbours: dict[int, list[str]] = {place: [] for place in view.places}
    for a, b, transitions in view.edges():
        neighbours[a].append(f"{view.place_id(b)} ×{transitions}")
        neighbours[b].append(f"{view.place_id(a)} ×{transitions}")
    objects = dict.fromkeys(view.places, 0)
    for found in view.objects:
        if found.place is not None:
            objects[found.place] += 1
    width = max(len(place.place_id) for place in view.places.values())
    lines = [f"{'place':<{width}}  keyframes  objects  centroid (m)        next to"]
    for ordinal, place in list(view.places.items())[:_MOST]:
        centroid = f"({place.centroid_x:.2f}, {place.centroid_y:.2f})"
        lines.append(
            f"{place.place_id:<{width}}  {place.keyframe_count:>9}  {objects[ordinal]:>7}  "
            f"{centroid:<18}  {', '.join(neighbours[ordinal])}".rstrip()
        )
    if len(view.places) > _MOST:
        lines.append(f"… and {len(view.places) - _MOST} more places; --json lists all")
    return lines
