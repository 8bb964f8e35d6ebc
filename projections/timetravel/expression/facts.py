"""What an expression may ask a map. Anything that answers these can be bisected over.

Ids are texts as people write them: a keyframe is ``run_id:keyframe_id``. A thing that is not in the
map (yet) is no error here: it is in no place, and its counts are 0.
"""

from typing import Protocol


class Facts(Protocol):
    """The map at one moment, asked by id."""

    def place_count(self) -> int:
        """Places that stand: formed and not absorbed."""

    def noise_count(self) -> int:
        """Keyframes with a pose that are in no place."""

    def keyframe_count(self, run_id: str | None = None) -> int:
        """Keyframes, of one run or of all, with or without a pose."""

    def object_count(self, class_name: str | None = None) -> int:
        """Objects, of one class or of all."""

    def place_of(self, keyframe: str) -> str | None:
        """The place a keyframe is in."""

    def located_in(self, object_id: str) -> str | None:
        """The place an object is in."""

    def sightings(self, object_id: str) -> int:
        """Observations fused into an object."""

    def size(self, place_id: str) -> int:
        """Keyframes in a place; 0 once it was absorbed."""

    def transitions(self, a: str, b: str) -> int:
        """Shared transitions of two places, in either order."""

    def merged(self, place_id: str) -> bool:
        """Whether a place was absorbed by another."""
