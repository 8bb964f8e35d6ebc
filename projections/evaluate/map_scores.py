"""Scores of the map itself: places against rooms, objects against instances."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from projections.view import MapView

from .clustering import agreement
from .truth import Key, Truth

SPANS_FROM = 0.1
"""A place spans two rooms when a second room has at least this share of its members."""


def place_scores(view: MapView, truth: Truth) -> dict[str, Any]:
    """Places against rooms, over placed keyframes whose room is known."""
    known = [(k, truth.room((k.run_id, k.keyframe_id))) for k in view.keyframes]
    labelled = [(room, k.place) for k, room in known if room is not None]
    placed = [(room, place) for room, place in labelled if place is not None]
    scores = agreement([room for room, _ in placed], [place for _, place in placed])
    posed = [k for k in view.keyframes if k.pose is not None]
    noise = sum(k.place is None for k in posed)
    spanning = sum(_spans(Counter(r for r, p in placed if p == place)) for place in view.places)
    return {
        "number": len(view.places),
        "rooms": len({room for room, _ in labelled}),
        "keyframes": len(placed),
        **asdict(scores),
        "noise_share": noise / len(posed) if posed else 0.0,
        "spanning_share": spanning / len(view.places) if view.places else 0.0,
    }


def _spans(rooms: Counter[str]) -> bool:
    counts = [n for _, n in rooms.most_common(2)]
    return len(counts) > 1 and counts[1] >= SPANS_FROM * rooms.total()


def object_scores(view: MapView, truth: Truth) -> dict[str, Any]:
    """Objects against instances, over fused observations whose instance is known.

    ``duplicates`` are Objects beyond the first of their instance, ``wrong_fusions`` Objects with
    observations of more than one instance, ``phantoms`` Objects of false positives alone.
    """
    seen = instances_of(view, truth)
    fused = [(i, view.observations[o].object) for o, i in seen if i is not None]
    pairs = [(instance, thing) for instance, thing in fused if thing is not None]
    scores = agreement([instance for instance, _ in pairs], [thing for _, thing in pairs])
    of_thing: dict[int, Counter[str]] = {}
    for instance, thing in pairs:
        of_thing.setdefault(thing, Counter())[instance] += 1
    owners = Counter(max(sorted(c), key=c.__getitem__) for c in of_thing.values())
    return {
        "number": len(view.objects),
        "instances": len({instance for instance, _ in pairs}),
        "observations": len(pairs),
        "homogeneity": scores.homogeneity,
        "completeness": scores.completeness,
        "v_measure": scores.v_measure,
        "adjusted_rand": scores.adjusted_rand,
        "duplicates": sum(n - 1 for n in owners.values()),
        "wrong_fusions": sum(len(c) > 1 for c in of_thing.values()),
        "phantoms": len(view.objects) - len(of_thing),
    }


def instances_of(view: MapView, truth: Truth) -> Iterable[tuple[int, str | None]]:
    """(observation, true instance or None) of every observation whose keyframe has truth."""
    for keyframe in view.keyframes:
        key: Key = (keyframe.run_id, keyframe.keyframe_id)
        if key in truth.keyframes:
            for index, observation in enumerate(keyframe.observations):
                yield observation, truth.instance(key, index)
