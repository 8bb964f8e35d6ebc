"""Names for the integers and strings that identify things.

An ``Offset`` is the index of an event in its log: 0, 1, 2 … without holes. It is the only order and
the only progress marker; times and keyframe ids are data.
"""

from typing import NewType

Offset = NewType("Offset", int)
RunId = NewType("RunId", str)
KeyframeId = NewType("KeyframeId", int)
DetId = NewType("DetId", str)


def default_det_id(run_id: str, keyframe_id: int, index: int) -> DetId:
    """The id of the ``index``-th detection (from 0) of a keyframe that names none itself."""
    return DetId(f"{run_id}_kf{keyframe_id}_d{index}")
