"""Candidates whose Places are the true rooms, so that ranking is tested without clustering."""

from collections.abc import Sequence

from projections.fold.exact import quantise, to_float32
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.localize.relocalize import CandidatePlace, Candidates, Crop, ExactIndex, Match
from projections.map.view import MapView
from tests.support.buildings import Keyframe


def fold(run: Sequence[Keyframe], **settings: float) -> MapView:
    """The map of a run."""
    chosen = Settings.model_validate({"eps_m": 1.0, **settings})
    semantic_map, view = SemanticMap(chosen), MapView(chosen)
    for offset, keyframe in enumerate(run):
        view.apply_event(offset, semantic_map.fold(offset, keyframe.accepted))
    return view


def crops_of(keyframe: Keyframe, *, boxes: bool = True) -> list[Crop]:
    """A keyframe's detections as crops."""
    return [
        Crop(
            to_float32(quantise(vector)),
            detection.bbox if boxes else None,
            detection.class_name,
            det_id,
        )
        for vector, detection, det_id in zip(
            keyframe.accepted.vectors,
            keyframe.accepted.envelope.detections,
            keyframe.accepted.det_ids,
            strict=True,
        )
        if vector is not None
    ]


class RoomMap:
    """A mapped run, searched exactly, with the rooms as Places."""

    def __init__(self, run: Sequence[Keyframe]) -> None:
        self.run = run
        self.view = fold(run)
        self._index = ExactIndex(self.view)
        self.rooms = sorted({keyframe.room for keyframe in run})
        self._places = {i: CandidatePlace(room, float(i), 0.0) for i, room in enumerate(self.rooms)}

    def search(self, crops: Sequence[Crop]) -> Candidates:
        """As `ExactIndex.search`, each match in the room its keyframe is in."""
        found = self._index.search(crops)
        rows = tuple(tuple(self._in_room(m) for m in row) for row in found.matches)
        return Candidates(rows, self._places)

    def _in_room(self, match: Match) -> Match:
        keyframe = self.view.observations[match.observation].keyframe
        room = self.rooms.index(self.run[keyframe].room)
        return match._replace(object_place=room, keyframe_place=room)
