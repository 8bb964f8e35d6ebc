"""Merges as people and programs read them."""

from typing import Any

from .bridging import chains_of
from .history import History
from .links import chain_document, link_document
from .lives import EdgeChange, Merge
from .story import keyframe_name, place_name

HEADER = ("#", "offset", "time", "bridge", "survivor", "absorbed", "keyframes", "objects", "edges")


def merge_document(history: History, merge: Merge) -> dict[str, Any]:
    """One merge as JSON; ``run_id`` and ``keyframe_id`` name the bridging keyframe."""
    bridge = history.keyframes[merge.bridge]
    return {
        **merge.cause.document(),
        "run_id": bridge.run_id,
        "keyframe_id": bridge.keyframe_id,
        "number": merge.number,
        "survivor": place_name(history, merge.survivor),
        "survivor_size": merge.survivor_size,
        "absorbed": [place_name(history, place) for place in merge.absorbed],
        "absorbed_sizes": list(merge.absorbed_sizes),
        "links": [link_document(history, link) for link in merge.links],
        "chains": [chain_document(history, chain) for chain in chains_of(history, merge)],
        "objects": [history.objects[number].object_id for number in merge.objects],
        "edges": [_edge_document(history, edge) for edge in merge.edges],
    }


def _edge_document(history: History, edge: EdgeChange) -> dict[str, Any]:
    return {
        "a": place_name(history, edge.a),
        "b": place_name(history, edge.b),
        "before": edge.before,
        "after": edge.after,
    }


def merge_row(history: History, merge: Merge) -> tuple[str, ...]:
    """One row of the table under `HEADER`."""
    return (
        str(merge.number),
        f"{merge.cause.offset:,}",
        merge.cause.when,
        keyframe_name(history, merge.bridge),
        place_name(history, merge.survivor),
        ", ".join(place_name(history, place) for place in merge.absorbed),
        " + ".join(str(size) for size in (merge.survivor_size, *merge.absorbed_sizes)),
        str(len(merge.objects)),
        str(len(merge.edges)),
    )
