"""Views made of deltas by hand, with their truth, for tests of the scores; the trial data."""

from collections.abc import Sequence
from types import ModuleType

from eventsrc.envelope.model import DetId
from projections.fold.deltas import (
    Delta,
    KeyframeAdded,
    KeyframeOrdinal,
    ObjectFound,
    ObjectOrdinal,
    ObjectSeen,
    ObservationAdded,
    ObservationOrdinal,
    Pose,
    RunOrdinal,
    RunSeen,
)
from projections.fold.settings import Settings
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from projections.map.view import MapView
from scripts.programs.bench.truth.worlds import load_generator
from tests.support.shared_data import WORLDS, skip_without

Sight = tuple[str, float, float, str | None, int]
"""Run, the robot's x and y in metres, true instance, Object."""


def hand_made(sights: Sequence[Sight], more: Sequence[Delta] = ()) -> tuple[MapView, Truth]:
    """A keyframe of one observation for each sight, then ``more`` deltas.

    Objects must be numbered in the order in which they are seen first.
    """
    view = MapView(Settings())
    keyframes: dict[tuple[str, int], TrueKeyframe] = {}
    runs = list(dict.fromkeys(run for run, *_ in sights))
    counts: dict[int, int] = {}
    for index, (run_id, x, y, instance, thing) in enumerate(sights):
        offset, run = index + 1, RunOrdinal(runs.index(run_id))
        keyframe, observation = KeyframeOrdinal(index), ObservationOrdinal(index)
        pose = Pose(round(x * 1e6), round(y * 1e6), 0.0)
        det_id, ordinal = DetId(f"d{index}"), ObjectOrdinal(thing)
        deltas: list[Delta] = [
            RunSeen(offset, run, run_id, 0.0),
            KeyframeAdded(offset, keyframe, run, run_id, index, float(index), pose),
            ObservationAdded(
                offset,
                observation,
                keyframe,
                run_id,
                index,
                det_id,
                "chair",
                0.9,
                (0.0, 0.0, 1.0, 1.0),
                None,
                None,
                False,
            ),
        ]
        if thing not in counts:
            deltas.append(ObjectFound(offset, ordinal, f"obj-{thing}", "chair", observation))
        counts[thing] = counts.get(thing, 0) + 1
        deltas.append(
            ObjectSeen(offset, ordinal, observation, 1 << 40, counts[thing], 0, 0, 0.0, 0.0)
        )
        view.apply_event(offset, deltas)
        keyframes[run_id, index] = TrueKeyframe(
            run_id=run_id, keyframe_id=index, room=None, instances=[instance]
        )
    view.apply_event(view.next_offset, more)
    return view, Truth(keyframes)


def trial_generator() -> ModuleType:
    """The generator of the trial data ``worlds``; skips the test where the data is absent."""
    skip_without(WORLDS, "MAPFOLD_SHARED_WORLDS")
    return load_generator(WORLDS)
