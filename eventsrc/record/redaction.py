"""What of a log a redaction erases: detections and keyframes, and all else that shows them.

A selection names detections, by id or class, or without these whole keyframes; run and time narrow
it. With what is selected go

* the crops and re-embedded vectors of these detections, and the sum of vectors in the command that
  puts them in force,
* the bytes of refused payloads that may say the same,
* messages of ROS that may show them: of the recordings that the selected keyframes are from, those
  of detections, embeddings and pictures; all messages of a recording whose runs all go, or that
  came before the time.

Commands and losses stay: they name runs and detections, and show nothing of them.
"""

import hashlib
import json
import sys
from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from eventsrc.envelope import commands
from eventsrc.envelope.crops import CROP_SCHEMA, InvalidCrop, decode_crop
from eventsrc.envelope.dropped_classes import ClassDropper, without_detections
from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    EMBEDDINGS_KEY,
    REDACTED_KEY,
    REJECTED_KEY,
    ROS_KEY,
    InvalidEmbeddings,
    RejectedPayload,
    decode_embeddings,
)
from eventsrc.log import Event, LogReader, VerbatimEvent
from eventsrc.log.redact import Rewritten

REDACTED_FIELD: Final = "redacted_detections"
_PICTURES: Final = (CROP_SCHEMA, "sensor_msgs/msg/Image")


@dataclass(frozen=True)
class Selection:
    """What is to be erased. Of several kinds of names each must fit; of one kind any.

    ``classes`` are recorded classes, or names of labels. ``before_ns`` compares with stamps of
    keyframes, and of other messages with their log times; ``before`` is the time as given. With
    ``crops_only`` pictures go, and nothing else.
    """

    det_ids: frozenset[str] = frozenset()
    runs: frozenset[str] = frozenset()
    classes: frozenset[str] = frozenset()
    before_ns: int | None = None
    before: str = ""
    crops_only: bool = False

    def __bool__(self) -> bool:
        return bool(self.det_ids or self.runs or self.classes or self.before_ns is not None)

    @property
    def takes_keyframes(self) -> bool:
        """Whether keyframes go whole."""
        return not (self.det_ids or self.classes)

    def __str__(self) -> str:
        named = (("det", self.det_ids), ("run", self.runs), ("class", self.classes))
        parts = [f"{name} {', '.join(sorted(names))}" for name, names in named if names]
        parts += [] if self.before_ns is None else [f"before {self.before}"]
        parts += ["crops only"] if self.crops_only else []
        return "; ".join(parts)[:2_000]


@dataclass
class _Recording:
    """A recording of ROS: its runs, and whether a keyframe of it is selected."""

    start: Offset
    runs: frozenset[str]
    is_hit: bool = False


@dataclass
class Erasure:
    """What a selection erases of a log; `decide` tells of each event. ``redaction_id`` is written
    into tombstones, ``labels`` are names of classes by recorded label."""

    selection: Selection
    redaction_id: str
    labels: dict[str, str] = field(default_factory=dict)
    det_ids: set[str] = field(default_factory=set)
    """The selected detections."""
    counts: Counter[str] = field(default_factory=Counter)
    """How many detections, keyframes, crops, vectors, refused payloads and messages go, and how
    many events could not be read."""
    changed: list[Offset] = field(default_factory=list)
    """The events that change, but for commands."""
    _recordings: list[_Recording] = field(default_factory=list)
    _starts: list[Offset] = field(default_factory=list)
    _commands: dict[Offset, bytes] = field(default_factory=dict)

    @classmethod
    def of(
        cls, reader: LogReader, selection: Selection, redaction_id: str, labels: dict[str, str]
    ) -> "Erasure":
        """Read a log for what the selection erases. Raises LogDamaged."""
        found = cls(selection, redaction_id, labels)
        for event in reader.read():
            if event.key == ROS_KEY:
                found._begin_recording(event)
            elif event.is_envelope:
                found._select(event)
        found._starts = [each.start for each in found._recordings]
        for event in reader.read():
            found._count(event)
        for event in reader.read(keys={COMMAND_KEY}):
            found._correct(reader, event)
        return found

    def _begin_recording(self, event: Event) -> None:
        from eventsrc.ros.derivation import read_recording  # here: few logs have messages of ROS

        try:
            streams = read_recording(event.payload).streams
        except ValidationError:
            streams = ()
        self._recordings.append(_Recording(event.offset, frozenset(s.run_id for s in streams)))

    def _select(self, event: Event) -> None:
        accepted = read_envelope(event, max_bytes=sys.maxsize)
        if not isinstance(accepted, Accepted):
            self.counts["unreadable"] += 1
            return
        found = self._selected(event, accepted)
        if found is not None:
            self.det_ids.update(accepted.det_ids[i] for i in found)
            if self._recordings and (found or self.selection.takes_keyframes):
                self._recordings[-1].is_hit = True

    def _selected(self, event: Event, accepted: Accepted) -> list[int] | None:
        """The detections that go; None if the keyframe is not among those that may."""
        by, envelope = self.selection, accepted.envelope
        if by.runs and envelope.run_id not in by.runs:
            return None
        if by.before_ns is not None and event.stamp_ns >= by.before_ns:
            return None
        return [
            i
            for i, each in enumerate(envelope.detections)
            if (not by.det_ids or accepted.det_ids[i] in by.det_ids)
            and (
                not by.classes
                or each.class_name in by.classes
                or self.labels.get(each.class_name) in by.classes
            )
        ]

    def decide(self, event: Event) -> Rewritten | None:
        """What an event becomes; None if it stays."""
        if isinstance(event, VerbatimEvent):
            return self._tombstone(event) if self._shows(event) else None
        if self.selection.crops_only or event.key == REDACTED_KEY:
            return None
        if event.is_envelope:
            return self._of_envelope(event)
        if event.key == REJECTED_KEY:
            return self._of_rejected(event)
        if event.key == EMBEDDINGS_KEY:
            return self._of_embeddings(event)
        corrected = self._commands.get(event.offset)
        return None if corrected is None else Rewritten(corrected)

    def _tombstone(self, event: Event) -> Rewritten:
        document = {"redaction": self.redaction_id, "key": event.key}
        return Rewritten(json.dumps(document, separators=(",", ":")).encode(), whole=True)

    def _of_envelope(self, event: Event) -> Rewritten | None:
        accepted = read_envelope(event, max_bytes=sys.maxsize)
        found = self._selected(event, accepted) if isinstance(accepted, Accepted) else None
        if not isinstance(accepted, Accepted) or found is None:
            return None
        if self.selection.takes_keyframes:
            return self._tombstone(event)
        if not found:
            return None
        gone = frozenset(found)
        left = [i for i in range(len(accepted.det_ids)) if i not in gone]
        fields = {REDACTED_FIELD: len(found), "redaction": self.redaction_id}
        of = event.payload, event.version, accepted.det_ids, left
        return Rewritten(without_detections(*of, fields))

    def _of_rejected(self, event: Event) -> Rewritten | None:
        """A refused payload without its bytes, if these may say what is erased."""
        try:
            refused = RejectedPayload.model_validate_json(event.payload)
        except ValidationError:
            return None
        raw, by = refused.raw, self.selection
        if not raw or (by.before_ns is not None and event.logged_ns >= by.before_ns):
            return None
        labels = {label for label, name in self.labels.items() if name in by.classes}
        names = (*by.det_ids, *by.runs, *by.classes, *labels)
        says = any(name.encode() in raw for name in names) or b"\\" in raw
        if names and not says and refused.size is None:
            return None
        hiding = ClassDropper[Any]([*names, REDACTED_FIELD])
        return Rewritten(hiding.refused_again(event.payload))

    def _of_embeddings(self, event: Event) -> Rewritten | None:
        try:
            made = decode_embeddings(event.payload)
        except InvalidEmbeddings:
            return None
        left = [i for i, det_id in enumerate(made.det_ids) if det_id not in self.det_ids]
        if len(left) == len(made.det_ids):
            return None
        if not left:
            return self._tombstone(event)
        det_ids, rows = tuple(made.det_ids[i] for i in left), np.array(left)
        return Rewritten(made._replace(det_ids=det_ids, vectors=made.vectors[rows]).encode())

    def _shows(self, event: VerbatimEvent) -> bool:
        """Whether a verbatim message is a crop of what is selected, or may show it."""
        schema, by = event.format.schema, self.selection
        if schema == CROP_SCHEMA:
            try:
                return decode_crop(event.payload).det_id in self.det_ids
            except InvalidCrop:  # another picture
                pass
        if by.crops_only and schema not in _PICTURES:
            return False
        if by.takes_keyframes and not by.runs:
            return by.before_ns is not None and event.logged_ns < by.before_ns
        at = bisect_right(self._starts, event.offset) - 1
        if at < 0 or not self._recordings[at].is_hit:
            return False
        all_runs_go = by.takes_keyframes and self._recordings[at].runs <= by.runs
        early = by.before_ns is None or event.logged_ns < by.before_ns
        from .importers.sources import SHOW_NOTHING  # here: few logs have messages of ROS

        return early and (all_runs_go or schema not in SHOW_NOTHING)

    def _count(self, event: Event) -> None:
        """Count what of an event goes."""
        change, counts = self.decide(event), self.counts
        if change is None:
            return
        self.changed.append(event.offset)
        if event.is_envelope and change.whole:
            counts["keyframes"] += 1
        elif event.is_envelope:
            counts["keyframes in part"] += 1
        elif event.key == REJECTED_KEY:
            counts["refused payloads"] += 1
        elif event.key == EMBEDDINGS_KEY:
            counts["events of vectors"] += 1
        elif isinstance(event, VerbatimEvent) and event.format.schema == CROP_SCHEMA:
            counts["crops"] += 1
        else:
            counts["messages of ROS"] += 1

    def _correct(self, reader: LogReader, event: Event) -> None:
        """Correct the sum of the vectors that a ``reembed`` command puts in force."""
        try:
            command = commands.parse_command(event.payload)
        except commands.InvalidCommand:
            return
        if not isinstance(command, commands.Reembed) or self.selection.crops_only:
            return
        digest, is_changed = hashlib.sha256(), False
        first, end = max(command.first, FIRST_OFFSET), command.end
        for each in reader.read(first, end, keys={EMBEDDINGS_KEY}):
            change = self.decide(each)
            is_changed = is_changed or change is not None
            if change is not None and change.whole:
                continue
            payload = each.payload if change is None else change.payload
            try:
                space = decode_embeddings(payload).space
            except InvalidEmbeddings:
                continue
            if space == command.space:
                digest.update(payload)
        if is_changed:
            corrected = command.model_copy(update={"sha256": digest.hexdigest()})
            self._commands[event.offset] = commands.encode_command(corrected)
