"""The best pictures of an Object, of the crops that a log keeps.

A view whose box ends at the edge of the picture, where the thing may be cut off, comes behind all
others. Then the view with the largest confidence times diagonal of its box is the best, and of
equal ones the first.
"""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.user_files import written_whole
from eventsrc.envelope.model import DetId, Offset
from eventsrc.log import LogReader
from projections.map.records import ObjectRecord, ObservationRecord
from projections.map.view import MapView

from .kept_crops import KeptCrops

_EDGE_PX: Final = 1.0
_MOST_TRIED: Final = 16
"""Views of an Object that are looked for: behind these the log keeps none of it, or poor ones."""


class View(NamedTuple):
    """The crop of a detection, a JPEG."""

    det_id: DetId
    jpeg: bytes


def views_in_order(view: MapView, found: ObjectRecord) -> list[ObservationRecord]:
    """The detections of an Object, the best view first."""

    def order(seen: ObservationRecord) -> tuple[bool, float, int]:
        x0, y0, x1, y1 = seen.bbox
        camera = view.keyframes[seen.keyframe].camera
        width, height = (camera.width_px, camera.height_px) if camera else (math.inf, math.inf)
        is_cut = min(x0, y0, width - x1, height - y1) <= _EDGE_PX
        return is_cut, -seen.confidence * math.hypot(x1 - x0, y1 - y0), seen.ordinal

    return sorted((view.observations[number] for number in found.observations), key=order)


def best_view(view: MapView, found: ObjectRecord, crops: KeptCrops) -> View | None:
    """The best of an Object's views that a log keeps a crop of, among the first `_MOST_TRIED`."""
    return next(best_views(view, found, crops, _MOST_TRIED), None)


def best_views(
    view: MapView, found: ObjectRecord, crops: KeptCrops, most: int | None = None
) -> Iterator[View]:
    """The crops that a log keeps of an Object, of its ``most`` best views, the best first."""
    for seen in views_in_order(view, found)[:most]:
        jpeg = crops.jpeg(seen.det_id, view.keyframes[seen.keyframe].offset)
        if jpeg is not None:
            yield View(seen.det_id, jpeg)


def write_best(view: MapView, object_ids: Iterable[str], log: Path, folder: Path) -> dict[str, str]:
    """Write the best crop that the log keeps of each Object that has one; the files by Object."""
    files: dict[str, str] = {}
    records = {each.object_id: each for each in view.objects.values()}
    with LogReader(log) as reader:
        kept = KeptCrops(reader)
        for object_id in object_ids:
            best = best_view(view, records[object_id], kept)
            if best is not None:
                files[object_id] = str(folder / f"{object_id}.jpg")
                with written_whole(Path(files[object_id])) as file:
                    file.write(best.jpeg)
    return files


class WrittenView(NamedTuple):
    """The file of a crop, the detection that it is of, and the offset of its keyframe's event."""

    file: str
    det_id: DetId
    offset: Offset


def write_views(view: MapView, object_id: str, log: Path, folder: Path) -> list[WrittenView]:
    """Write the crops that the log keeps of the `_MOST_TRIED` best views of an Object."""
    found = next(each for each in view.all_objects if each.object_id == object_id)
    offsets = {
        seen.det_id: view.keyframes[seen.keyframe].offset for seen in views_in_order(view, found)
    }
    written = list[WrittenView]()
    with LogReader(log) as reader:
        for each in best_views(view, found, KeptCrops(reader), _MOST_TRIED):
            path = folder / f"{object_id}-{len(written) + 1}.jpg"
            with written_whole(path) as file:
                file.write(each.jpeg)
            written.append(WrittenView(str(path), each.det_id, offsets[each.det_id]))
    return written
