"""Two folds of one log made comparable, keyframe by keyframe and observation by observation.

Under other settings a log has the same keyframes and observations; corrections leave some out. A
keyframe is known by its event, an observation by its event and det_id.
"""

from array import array
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from eventsrc.envelope import DetId

from .history import NEVER
from .parallel import NO_NUMBER, FoldResult

_K = TypeVar("_K", bound=Hashable)
_V = TypeVar("_V")


def aligned(first: FoldResult, second: FoldResult) -> tuple[FoldResult, FoldResult]:
    """Both with the keyframes and observations of either, in the order of the log.

    One that a fold leaves out is in no place, or of no object, there.
    """
    if (
        first.keyframe_offsets == second.keyframe_offsets
        and first.observation_offsets == second.observation_offsets
        and first.det_ids == second.det_ids
    ):
        return first, second
    keyframes = sorted({*first.keyframe_offsets, *second.keyframe_offsets})
    observations = sorted({*_observations(first), *_observations(second)})
    return _with(first, keyframes, observations), _with(second, keyframes, observations)


def _observations(result: FoldResult) -> list[tuple[int, DetId]]:
    return list(zip(result.observation_offsets, result.det_ids, strict=True))


def _with(
    result: FoldResult, keyframes: list[int], observations: list[tuple[int, DetId]]
) -> FoldResult:
    """The result with these keyframes and observations, among them all of its own."""
    own = {offset: ordinal for ordinal, offset in enumerate(result.keyframe_offsets)}
    posed = {result.keyframe_offsets[ordinal] for ordinal in result.posed}
    seen = {key: ordinal for ordinal, key in enumerate(_observations(result))}
    return replace(
        result,
        places=tuple(_values(keyframes, own, result.places, None)),
        posed=array("q", (i for i, offset in enumerate(keyframes) if offset in posed)),
        keyframe_offsets=array("q", keyframes),
        placed_offsets=array("q", _values(keyframes, own, result.placed_offsets, int(NEVER))),
        placed_in=array("q", _values(keyframes, own, result.placed_in, NO_NUMBER)),
        objects=tuple(_values(observations, seen, result.objects, None)),
        fused_into=array("q", _values(observations, seen, result.fused_into, NO_NUMBER)),
        observation_offsets=array("q", (offset for offset, _ in observations)),
        det_ids=tuple(det_id for _, det_id in observations),
    )


def _values(
    keys: Sequence[_K], ordinals: Mapping[_K, int], values: Sequence[_V], missing: _V
) -> list[_V]:
    """The value of each key, ``missing`` for one that has none."""
    return [missing if (at := ordinals.get(key)) is None else values[at] for key in keys]
