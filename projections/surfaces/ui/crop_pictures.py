"""The crops that the log keeps of an Object or of a keyframe's detections, for the page.

They are in the answer itself, as base64, so that they need no more than its token. At most
`MOST_PICTURES` of `MOST_BYTES` together.
"""

from base64 import b64encode
from collections.abc import Iterable
from itertools import groupby
from typing import Any, Final

from starlette.datastructures import QueryParams

from projections.ask.best_views import views_in_order
from projections.fold.deltas import ObjectOrdinal
from projections.fold.map_errors import QuestionError
from projections.history.names import find_keyframe
from projections.map.naming import thing_called, things_of
from projections.map.records import ObservationRecord
from projections.map.view import MapView

from .log_map import LogMap
from .requests import AskedPoint, number_of, text_of

MOST_PICTURES: Final = 24
MOST_BYTES: Final = 4_000_000
_MOST_OF_A_RUN: Final = 8


def pictures_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The crops of the Object or keyframe named by ``what``: of an Object the latest run first, and
    of each run the best view first; of a keyframe in the order of its detections."""
    asked = AskedPoint.of(shown, query)
    what = text_of(query, "what")
    kind, _, name = what.partition(":")
    view = asked.known.at(asked.end)
    seen: Iterable[ObservationRecord]
    if kind == "object":
        meant = thing_called(name, things_of(view), ["object"])
        found = view.all_objects[view.object_survivors.find(ObjectOrdinal(meant.ordinal))]
        seen = _by_run(view, views_in_order(view, found))
    elif kind == "keyframe":
        ordinal = find_keyframe(asked.known.history, ":".join(name.rsplit("/", 1)))
        of_it = view.keyframes[ordinal].observations if ordinal < len(view.keyframes) else []
        seen = [view.observations[number] for number in of_it][:MOST_PICTURES]
    else:
        raise QuestionError(f"what is {what[:80]!r}; write object:ID or keyframe:RUN/ID")
    most = min(number_of(query, "top", MOST_PICTURES), MOST_PICTURES)
    return {**asked.document(), "pictures": _pictures(shown, view, seen, most)}


def _by_run(view: MapView, seen: list[ObservationRecord]) -> list[ObservationRecord]:
    def run(each: ObservationRecord) -> int:
        return view.keyframes[each.keyframe].run

    runs = groupby(sorted(seen, key=lambda each: -run(each)), run)
    return [each for _, views in runs for each in list(views)[:_MOST_OF_A_RUN]]


def _pictures(
    shown: LogMap, view: MapView, seen: Iterable[ObservationRecord], most: int
) -> list[dict[str, Any]]:
    found, size = list[dict[str, Any]](), 0
    for each in seen:
        if len(found) == most:
            break
        keyframe = view.keyframes[each.keyframe]
        jpeg = shown.crops.jpeg(each.det_id, keyframe.offset)
        if jpeg is None or size + len(jpeg) > MOST_BYTES:
            continue
        size += len(jpeg)
        camera = keyframe.camera
        found.append(
            {
                "det_id": each.det_id,
                "class_name": each.class_name,
                "confidence": each.confidence,
                "bbox": list(each.bbox),
                "picture": [camera.width_px, camera.height_px] if camera else None,
                "run_id": keyframe.run_id,
                "keyframe_id": keyframe.keyframe_id,
                "offset": keyframe.offset,
                "jpeg": b64encode(jpeg).decode("ascii"),
            }
        )
    return found
