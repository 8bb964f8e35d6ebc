"""The same question to a past map: the log folded to a point, searched exactly."""

from collections.abc import Sequence
from pathlib import Path

from eventsrc.log import LogReader
from eventsrc.log.whence import Note, resolve
from projections.folding import fold_log
from projections.settings import Settings

from .answer import Answer
from .camera import Camera
from .crops import Crop
from .exact_search import ExactIndex
from .rank import DEFAULT_CAMERA, Method, rank


def relocalize_as_of(
    log: Path,
    whence: str,
    settings: Settings,
    crops: Sequence[Crop],
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera = DEFAULT_CAMERA,
    note: Note | None = None,
) -> Answer:
    """Where the robot is by the map as of ``whence``: offset, ISO time, run:keyframe or end.

    ``note`` is told what a reader of ``whence`` might wonder about (`eventsrc.log.whence.resolve`).
    """
    with LogReader(log) as reader:
        _, view = fold_log(reader, settings, resolve(reader, whence, note=note))
    candidates = ExactIndex(view).search(crops)
    return rank(crops, candidates, top=top, method=method, camera=camera)
