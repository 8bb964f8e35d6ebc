"""Classes whose detections a log never stores, and what is left out for them.

A ``mapfold/drop`` event names classes. From there on every recorder and every import of that log
leaves out their detections before anything is appended: the detection with its vector, its crop,
and whatever else may show it.

* An envelope is stored without them, with their number as ``dropped_detections``. The ids that the
  others have by their places in the list are then written out. Its other fields stay as they are.
* A crop is stored once an envelope has come that keeps its detection; of one that came first at
  most `HELD_BYTES` wait in memory.
* A refused payload is stored without its bytes and without the value at fault.

The class is the one that was recorded, letter by letter, or a label that the log names so.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Final, Generic, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import from_json

from .forms import BARE_LIST_VERSION
from .model import DetId, KeyframeId, RunId, Text, default_det_id
from .system_events import Excerpt, RejectedPayload

MAX_CLASSES: Final = 1_000
"""Bound of the classes in one event."""
DROPPED_FIELD: Final = "dropped_detections"
"""The field of an envelope with the number of detections that it was stored without."""
HELD_CROPS: Final = 4_096
HELD_BYTES: Final = 32 * 1024 * 1024
KNOWN_IDS: Final = 100_000
"""How many of the last det_ids are known as kept, and as dropped."""
_NOT_KEPT: Final = "; the log drops classes, so the bytes are not kept"
_VALUE: Final = " (got "

Item = TypeVar("Item")


class DropClasses(BaseModel):
    """The content of a ``mapfold/drop`` event: classes whose detections the log stores no more.

    There is no event that takes it back.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    classes: Annotated[tuple[Text, ...], Field(min_length=1, max_length=MAX_CLASSES)]
    issued_by: Text | None = None

    def encode(self) -> bytes:
        """The event's JSON."""
        return self.model_dump_json(exclude_none=True).encode()


class Stripped(NamedTuple):
    """A payload without the detections of dropped classes, and the ids of those that it had."""

    payload: bytes
    kept: tuple[DetId, ...] = ()
    dropped: tuple[DetId, ...] = ()


class Dropped(NamedTuple):
    """How many detections and crops were left out, crops whose detection has not come included."""

    detections: int
    crops: int


NO_DROPPED: Final = Dropped(0, 0)


class ClassDropper(Generic[Item]):
    """Leaves out what a log never stores; false if that is nothing. Belongs to one thread.

    ``labels`` are names of classes by recorded label. Crops are of any type, ``Item``.
    """

    def __init__(self, classes: Iterable[str] = (), labels: Mapping[str, str] = {}) -> None:
        self._labels = labels
        self.classes: frozenset[str] = frozenset()
        self.add(classes)
        self._detections = self._crops = 0
        self._kept: dict[str, None] = {}
        self._dropped: dict[str, None] = {}
        self._held: dict[str, tuple[Item, int]] = {}
        self._held_bytes = 0

    def add(self, classes: Iterable[str]) -> bool:
        """Drop these classes, too, from now on; whether any is new."""
        named = frozenset(classes)
        before = self.classes
        labels = {label for label, name in self._labels.items() if name in named}
        self.classes = before | named | labels
        return self.classes != before

    def __bool__(self) -> bool:
        return bool(self.classes)

    @property
    def counts(self) -> Dropped:
        """What was left out so far; may be asked for from any thread."""
        return Dropped(self._detections, self._crops + len(self._held))

    def strip(self, payload: bytes, version: int) -> Stripped:
        """``payload``, a valid envelope of this version, without dropped detections. Raises
        ValueError for one that cannot be read a second time."""
        if not self.classes:
            return Stripped(payload)
        document = from_json(payload)
        if version == BARE_LIST_VERSION:
            left = [each for each in document if not self.drops(each)]
            return self._stored(payload, left, len(document) - len(left))
        given = document["detections"]
        of = RunId(document["run_id"]), KeyframeId(document["keyframe_id"])
        ids = [each.get("det_id") or default_det_id(*of, i) for i, each in enumerate(given)]
        kept = [i for i, each in enumerate(given) if not self.drops(each)]
        left = [{**given[i], "det_id": ids[i]} for i in kept]
        count = len(given) - len(kept)
        before = document.get(DROPPED_FIELD)
        number = count + (before if type(before) is int and before > 0 else 0)
        stored = {**document, "detections": left, DROPPED_FIELD: number}
        stay = tuple(ids[i] for i in kept)
        dropped = tuple(det_id for det_id in dict.fromkeys(ids) if det_id not in stay)
        return Stripped(self._stored(payload, stored, count).payload, stay, dropped)

    def drops(self, detection: Mapping[str, Any]) -> bool:
        """Whether a detection, as it came, is of a dropped class."""
        given = (detection.get(name) for name in ("class", "class_name"))
        return any(isinstance(name, str) and name in self.classes for name in given)

    def _stored(self, payload: bytes, document: object, count: int) -> Stripped:
        self._detections += count
        return Stripped(_encoded(document) if count else payload)

    def release(self, stripped: Stripped) -> list[Item]:
        """Note which detections of an envelope are kept; the crops that waited for them."""
        _note(self._kept, stripped.kept)
        _note(self._dropped, stripped.dropped)
        found = [self._take(det_id) for det_id in (*stripped.kept, *stripped.dropped)]
        crops = [item for item in found[: len(stripped.kept)] if item is not None]
        self._crops += sum(item is not None for item in found[len(stripped.kept) :])
        return crops

    def crop(self, det_id: str, item: Item, size: int) -> list[Item]:
        """A crop to store now, if that of a detection that is kept; else it waits for its envelope,
        or is left out. ``size`` is how many bytes it takes."""
        if not self.classes:
            return [item]
        if det_id in self._dropped:
            self._crops += 1
            return []
        if det_id in self._kept:
            return [item]
        self._crops += self._take(det_id) is not None  # sent again
        self._held[det_id] = item, size
        self._held_bytes += size
        while len(self._held) > HELD_CROPS or self._held_bytes > HELD_BYTES:
            self._take(next(iter(self._held)))
            self._crops += 1
        return []

    def _take(self, det_id: str) -> Item | None:
        found = self._held.pop(det_id, None)
        if found is None:
            return None
        self._held_bytes -= found[1]
        return found[0]

    def knows_dropped(self, det_id: str) -> bool:
        """Whether an envelope had this detection and was stored without it."""
        return det_id in self._dropped

    def reason(self, reason: str) -> str:
        """The reason of a refusal without the value at fault."""
        return reason.partition(_VALUE)[0] + _NOT_KEPT if self.classes else reason

    def kept_of(self, payload: bytes | Excerpt) -> bytes | Excerpt:
        """What is kept of a refused payload: all of it, or only its size and SHA-256."""
        if not self.classes:
            return payload
        if isinstance(payload, Excerpt):
            return payload._replace(start=b"")
        return Excerpt(b"", len(payload), hashlib.sha256(payload).hexdigest())

    def refused_again(self, event: bytes) -> bytes:
        """The event of a refusal that another log has, as this one keeps it. Raises
        ValidationError for bytes that are no such event."""
        if not self.classes:
            return event
        found = RejectedPayload.model_validate_json(event)
        if not found.payload:
            return event
        kept = found.raw
        excerpt = Excerpt.of((kept,))
        if found.size is not None and found.sha256 is not None:
            excerpt = Excerpt(b"", found.size, found.sha256)
        return RejectedPayload.encode(
            found.key, self.reason(found.reason), excerpt._replace(start=b"")
        )


def without_detections(
    payload: bytes,
    version: int,
    det_ids: Sequence[DetId],
    left: Sequence[int],
    fields: Mapping[str, object],
) -> bytes:
    """A valid envelope of this version with only the detections ``left``, by index, which keep
    their ids, and with ``fields``, which a bare list has no place for."""
    document = from_json(payload)
    given = document if version == BARE_LIST_VERSION else document["detections"]
    kept = [{**given[i], "det_id": det_ids[i]} for i in left]
    if version == BARE_LIST_VERSION:
        return _encoded(kept)
    return _encoded({**document, "detections": kept, **fields})


def _encoded(document: object) -> bytes:
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.encode()


def _note(known: dict[str, None], det_ids: Iterable[str]) -> None:
    known.update(dict.fromkeys(det_ids))
    while len(known) > KNOWN_IDS:
        del known[next(iter(known))]
