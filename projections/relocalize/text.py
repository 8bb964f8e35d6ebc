"""An answer as people read it."""

import math

from projections.relocalize import UNKNOWN_BELOW, Answer, RankedPlace


def answer_text(answer: Answer) -> str:
    """A few lines: where, how sure, and what speaks for it."""
    lines = [_verdict(answer), _pose(answer)]
    for number, place in enumerate(answer.places, start=1):
        lines += _place(number, place)
    return "\n".join(line for line in lines if line) + "\n"


def _verdict(answer: Answer) -> str:
    sure = f"confidence {answer.confidence:.2f}"
    if not answer.places:
        return f"unknown: nothing in the map looks like these crops ({sure})"
    if answer.unknown:
        return f"unknown: {sure} is below {UNKNOWN_BELOW}; the likeliest places would be"
    return f"{answer.places[0].place_id} ({sure})"


def _pose(answer: Answer) -> str:
    pose = answer.pose
    if pose is None:
        return ""
    yaw = "" if pose.yaw is None else f", facing {math.degrees(pose.yaw):.0f}°"
    return f"pose ({pose.x:.2f}, {pose.y:.2f}) m{yaw}, spread {pose.spread_m:.2f} m"


def _place(number: int, place: RankedPlace) -> list[str]:
    centre = f"({place.centroid_x:.2f}, {place.centroid_y:.2f}) m"
    lines = [f"{number}. {place.place_id}  score {place.score:.3f}  centroid {centre}"]
    lines += [
        f"   {e.similarity:.3f}  {e.class_name}  {e.object_id or 'no object'}  {e.det_id}"
        for e in place.evidence
    ]
    return lines
