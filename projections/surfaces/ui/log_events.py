"""Marks of the timeline: keyframes, places founded and merged, commands, rejected payloads, losses.

Places and objects are marked by their history. Commands, rejected payloads and losses are mapfold's
own events, which the fold does not use; they are read from the log by their keys.
"""

import json
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from itertools import chain
from operator import itemgetter
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from eventsrc.envelope.commands import InvalidCommand, UnknownKind, parse_command
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import COMMAND_KEY, LOSS_KEY, REJECTED_KEY, Loss
from eventsrc.log import Event, LogReader
from projections.map.phrases import command_title
from projections.store.columns import Array
from projections.store.history import History

KINDS: Final = (
    "keyframe",
    "run_began",
    "place_founded",
    "place_merged",
    "merge_refused",
    "objects_merged",
    "object_missing",
    "object_moved",
    "skipped",
    "correction",
    "rejected",
    "loss",
)
"""``ev_kind`` is an index of these."""
_NUMBER: Final = {kind: number for number, kind in enumerate(KINDS)}
_SYSTEM_KEYS: Final = {COMMAND_KEY: "correction", REJECTED_KEY: "rejected", LOSS_KEY: "loss"}
_MAX_TEXT: Final = 300
MOST_REPORTS: Final = 20_000
_Mark = tuple[int, int, float, int]
"""Offset, number of the kind, stamp in seconds, and what it refers to."""


class LogEvents:
    """mapfold's own events of a log, read once; `read_on` adds those recorded since.

    All commands are kept, and the first ``most`` of rejected payloads and losses together, since a
    faulty robot makes millions in a day. All are counted.
    """

    def __init__(self, most: int = MOST_REPORTS) -> None:
        self._most = most
        self._reports = 0
        self.through = FIRST_OFFSET
        self.events: list[dict[str, Any]] = []
        self.rejected = 0
        self.losses = 0
        """Messages that were lost."""

    @property
    def left_out(self) -> int:
        """The number of rejected payloads and losses that are not among the events."""
        return max(0, self._reports - self._most)

    def read_on(self, reader: LogReader, end: Offset) -> None:
        """Read those below ``end``. After an exception they are as they were. Raises LogDamaged."""
        counts = self._reports, self.rejected, self.losses, len(self.events)
        try:
            for event in reader.read(self.through, end, keys=tuple(_SYSTEM_KEYS)):
                self._add(event)
            self.through = end
        except BaseException:
            self._reports, self.rejected, self.losses, kept = counts
            del self.events[kept:]
            raise

    def _add(self, event: Event) -> None:
        kind = _SYSTEM_KEYS[event.key]
        if kind != "correction":
            self._reports += 1
            self.rejected += kind == "rejected"
            if kind == "rejected" and self.left_out:
                return
        document = _document(event)
        self.losses += document.get("count") or 0
        if kind == "correction" or not self.left_out:
            self.events.append(document)

    def count_before(self, offset: int) -> int:
        """The number of events below ``offset``."""
        return bisect_left(self.events, offset, key=itemgetter("offset"))


def _document(event: Event) -> dict[str, Any]:
    kind = _SYSTEM_KEYS[event.key]
    described = _command(event) if kind == "correction" else _DESCRIBE[kind](event.payload)
    return {
        "offset": event.offset,
        "kind": kind,
        "stamp": event.stamp_ns / 1e9,
        **described,
        "text": described["text"][:_MAX_TEXT],
    }


def _command(event: Event) -> dict[str, Any]:
    try:
        command = parse_command(event.payload)
    except (InvalidCommand, UnknownKind) as error:
        return {"text": str(error), "command_id": None, "what": None}
    return {
        "text": command_title(command),
        "command_id": command.command_id,
        "what": command.kind,
    }


def _loss(payload: bytes) -> dict[str, Any]:
    try:
        loss = Loss.model_validate_json(payload)
    except ValidationError:
        return {"text": "a loss that this version cannot read", "count": None}
    span = "" if loss.first is None else f", {loss.first} to {loss.last}"
    return {"text": f"{loss.count} lost of {loss.publisher}{span} ({loss.cause})"} | {
        "count": loss.count
    }


def _rejected(payload: bytes) -> dict[str, Any]:
    try:
        found = json.loads(payload)
        return {"text": f"{found['key']}: {found['reason']}"}
    except (ValueError, TypeError, KeyError, RecursionError):
        return {"text": "a rejected payload that this version cannot read"}


_DESCRIBE: Final = {"loss": _loss, "rejected": _rejected}


def event_columns(
    history: History, start: Offset, log_events: LogEvents
) -> tuple[dict[str, Array], dict[str, Any]]:
    """The columns ``ev_`` from ``start`` on, and what the header says about them.

    ``ev_ref`` is a keyframe, run, place or object; of ``place_merged`` and ``objects_merged`` the
    one that was absorbed; of ``merge_refused`` an index of ``refusals``; of mapfold's own events an
    index of ``system``.
    """
    system = log_events.events[log_events.count_before(start) :]
    own = log_events.count_before(start)
    marks: list[_Mark] = [
        (each["offset"], _NUMBER[each["kind"]], each["stamp"], own + index)
        for index, each in enumerate(system)
    ]
    marks += _history_marks(history, start)
    marks.sort(key=itemgetter(0, 1))
    refused = [r for r in history.refusals if r.cause.offset >= start]
    header = {
        "kinds": list(KINDS),
        "system": [{k: v for k, v in each.items() if k != "stamp"} for each in system],
        "refusals": [{"offset": r.cause.offset, "a": r.a, "b": r.b} for r in refused],
    }
    return {
        "ev_offset": np.array([mark[0] for mark in marks], "<i4"),
        "ev_stamp": np.array([mark[2] for mark in marks], "<f8"),
        "ev_kind": np.array([mark[1] for mark in marks], "|u1"),
        "ev_ref": np.array([mark[3] for mark in marks], "<i4"),
    }, header


def _history_marks(history: History, start: Offset) -> Iterator[_Mark]:
    keyframes, offsets = history.keyframes, history.keyframe_offsets
    found = chain(
        (("keyframe", k.offset, k.keyframe) for k in keyframes[bisect_left(offsets, start) :]),
        (("run_began", seen[0].offset, number) for number, seen in enumerate(history.runs)),
        (("place_founded", p.formed.offset, p.formed.place) for p in history.places),
        (("place_merged", m.cause.offset, p) for m in history.merges for p in m.absorbed),
        (("merge_refused", r.cause.offset, i) for i, r in enumerate(history.refusals)),
        (("objects_merged", m.offset, m.absorbed) for m in history.object_merges),
        (
            ("object_missing", miss.offset, miss.object)
            for each in history.objects
            for before, miss in zip([None, *each.misses], each.misses, strict=False)
            if miss.missing and not (before is not None and before.missing)
        ),
        (("object_moved", r.offset, r.object) for o in history.objects for r in o.relocations),
        (("skipped", s.offset, -1) for s in history.skipped),
    )
    for kind, offset, ref in found:
        if offset >= start:
            number = bisect_right(offsets, offset)  # the keyframe of the event, or the last before
            yield offset, _NUMBER[kind], keyframes[number - 1].timestamp if number else np.nan, ref
