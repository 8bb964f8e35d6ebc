"""The crops that a log keeps of its detections.

A crop stands near the keyframe of its detection, so it is looked for there first. One that is not
there, as of a log into which crops were imported later, is found by an index of all crops, which is
made when it is needed and extended as the log grows.
"""

from collections.abc import Iterator
from typing import Final

from eventsrc.envelope.crops import CROPS_TOPIC, Crop, InvalidCrop, decode_crop
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader

_BEFORE: Final = 64
_BEHIND: Final = 256
"""Events before and behind a keyframe among which its crops are looked for first."""


class KeptCrops:
    """The crops on the topic `CROPS_TOPIC` of an open log; for one thread at a time. Events that
    cannot be read have none."""

    def __init__(self, reader: LogReader) -> None:
        self._reader = reader
        self._offsets: dict[str, Offset] = {}
        self._indexed = FIRST_OFFSET

    def jpeg(self, det_id: str, near: Offset | None = None) -> bytes | None:
        """The JPEG of a detection; None if the log keeps none. ``near`` is the offset of its
        keyframe."""
        if near is not None:
            start, end = Offset(max(0, near - _BEFORE)), Offset(near + _BEHIND)
            for _, crop in self._crops(start, end):
                if crop.det_id == det_id:
                    return crop.jpeg
        at = self._index().get(det_id)
        found = () if at is None else self._crops(at, Offset(at + 1))
        return next((crop.jpeg for _, crop in found), None)

    @property
    def are_kept(self) -> bool:
        """Whether the log keeps any crop."""
        if not self._offsets:
            end = self._reader.readable_end
            found = next(self._crops(self._indexed, end), None)
            if found is not None:
                end, self._offsets[found[1].det_id] = Offset(found[0] + 1), found[0]
            self._indexed = max(self._indexed, end)
        return bool(self._offsets)

    def _index(self) -> dict[str, Offset]:
        """The offset of each crop; of several of one detection the first."""
        end = self._reader.readable_end
        for offset, crop in self._crops(self._indexed, end):
            self._offsets.setdefault(crop.det_id, offset)
        self._indexed = max(self._indexed, end)
        return self._offsets

    def _crops(self, start: Offset, end: Offset) -> Iterator[tuple[Offset, Crop]]:
        read = self._reader.read(start, end, keys={CROPS_TOPIC}, on_gap=lambda _: None)
        for event in read:
            try:
                yield event.offset, decode_crop(event.payload)
            except InvalidCrop:  # `reembed` counts it
                continue
