"""Verification of events: findings that checksums cannot show.

Findings of a kind are counted and reported once for each run or key, with the first and last
offset.

Gaps: a gap ledger is folded over the log, as by `log info` and `status`; late keyframes close gaps.

Log times: each event should be logged after the one before. Occupancy maps are left out of this: a
map is imported when it becomes available, before recordings of any age, and nothing depends on its
time.

Stamps: a robot numbers its keyframes in the order it took them, so its stamps should grow with
their numbers, in whatever order they reached the log. A finding is a keyframe stamped before its
predecessor by number (the robot's clock was set back), or more than a day after it (the clock was
set while the robot drove). Stamps far from the log time are no finding: runs are imported long
after, and robots have clocks of their own.
"""

import hashlib
from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, Literal, NamedTuple, TypeVar

from pydantic import ValidationError

from eventsrc.base.text import visible
from eventsrc.envelope import system_events
from eventsrc.envelope.commands import InvalidCommand, encode_command, parse_command
from eventsrc.envelope.dropped_classes import DropClasses
from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.gaps import Gap, GapLedger, gap_of
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import KeyframeId, Offset, RunId, has_keyframe_id
from eventsrc.envelope.occupancy_map import InvalidMap, decode_map
from eventsrc.envelope.system_events import InvalidEmbeddings, decode_embeddings

from .event import Event

_LOST: Final = {
    "keyframe_gap": "missing keyframes of run {}",
    "queue_full": "messages on key {} lost because the queue was full",
    "too_large": "messages on key {} lost because they were too large",
    "transport_miss": "messages of publisher {} that were not received",
    "rot": "recorded events lost to damage",
}
"""Text of a loss by its cause, for the id of its publisher."""


class OpenGaps(NamedTuple):
    """How many keyframes of a run were reported missing and never came, and the offsets of the
    first and last event that reports any of them."""

    run_id: RunId
    missing: int
    first_offset: Offset
    last_offset: Offset


class ReportedGaps:
    """The reported gaps that are still open. Keyframes and reports are added in offset order."""

    def __init__(self) -> None:
        self._ledger: GapLedger[RunId] = GapLedger()
        self._reports: defaultdict[RunId, list[tuple[Offset, Gap[RunId]]]] = defaultdict(list)

    def add_keyframe(self, run_id: RunId, keyframe_id: KeyframeId) -> None:
        """Add a recorded keyframe."""
        self._ledger.record(run_id, keyframe_id, 0)

    def add_report(self, offset: Offset, gap: Gap[RunId]) -> None:
        """Add the gap that the loss event at ``offset`` reports."""
        self._reports[gap.run_id].append((offset, gap))
        self._ledger.add_reported(gap, 0)

    def still_open(self) -> Iterator[OpenGaps]:
        """The keyframes that are still missing, by run."""
        missing: defaultdict[RunId, list[Gap[RunId]]] = defaultdict(list)
        for gap in self._ledger.reported_gaps():
            missing[gap.run_id].append(gap)
        for run_id, gaps in missing.items():
            ends = [gap.last for gap in gaps]
            offsets = [
                offset
                for offset, reported in self._reports[run_id]
                if (index := bisect_left(ends, reported.first)) < len(gaps)
                and gaps[index].first <= reported.last
            ]
            yield OpenGaps(run_id, sum(gap.count for gap in gaps), offsets[0], offsets[-1])


JUMP_NS = 24 * 3600 * 1_000_000_000


class StampFinding(NamedTuple):
    """A finding about the stamp of the keyframe at ``offset``."""

    offset: Offset
    message: str


@dataclass(slots=True)
class _Run:
    keyframes: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))


class RunStamps:
    """Checks the stamps of runs. Each keyframe is added once, in offset order; three numbers of
    each are kept."""

    def __init__(self) -> None:
        self._runs: dict[RunId, _Run] = {}

    def add(self, run_id: RunId, keyframe_id: KeyframeId, stamp_ns: int, offset: Offset) -> None:
        """Add the next keyframe of the log."""
        run = self._runs.setdefault(run_id, _Run())
        run.keyframes.append(keyframe_id)
        run.stamps.append(stamp_ns)
        run.offsets.append(offset)

    def findings(self) -> Iterator[StampFinding]:
        """The findings, run by run in the order of keyframe ids."""
        for run_id, run in self._runs.items():
            order = sorted(range(len(run.keyframes)), key=run.keyframes.__getitem__)
            for before, this in pairwise(order):
                step_ns = run.stamps[this] - run.stamps[before]
                if step_ns < 0:
                    yield StampFinding(
                        Offset(run.offsets[this]), f"stamps of run {run_id} run backwards"
                    )
                elif step_ns > JUMP_NS:
                    yield StampFinding(
                        Offset(run.offsets[this]), f"stamps of run {run_id} jump by more than a day"
                    )


Kind = Literal[
    "crc", "gap", "chain", "log_id", "torn", "schema", "duplicate", "time", "loss", "redaction"
]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong. ``first_offset`` and ``last_offset`` are the first and last event it
    concerns, None if it concerns none; ``count`` is how many.

    crc        bytes differ from what was written
    gap        events that were recorded are not there
    chain      a segment is not the one its successor was written after
    log_id     a segment belongs to another log
    torn       an end that was being written when its writer died; never recorded
    schema     an event the fold cannot read
    duplicate  a keyframe that stands more than once (the fold takes the first)
    time       a clock that ran backwards, or was set while a robot drove
    loss       what the log says never came and did not come late either, or was lost to damage
    redaction  a payload is not what a redaction put there, or one is not finished
    """

    kind: Kind
    message: str
    segment: str | None = None
    first_offset: Offset | None = None
    last_offset: Offset | None = None
    count: int = 1


T = TypeVar("T")


def _read_recording(payload: bytes) -> object:
    from eventsrc.ros.derivation import read_recording  # here: few logs have messages of ROS

    return read_recording(payload)


_READERS: Final[dict[str, Callable[[bytes], object]]] = {
    system_events.REJECTED_KEY: system_events.RejectedPayload.model_validate_json,
    system_events.MAP_KEY: decode_map,
    system_events.ROS_KEY: _read_recording,
    system_events.EMBEDDINGS_KEY: decode_embeddings,
    system_events.DROP_KEY: DropClasses.model_validate_json,
}
"""By key, what reads events that need no further check."""

_BACKWARDS = (
    "logged_ns runs backwards: the clock was set back, or a file was imported that is not in order"
)


@dataclass(slots=True)
class _Group:
    """Findings that are reported as one."""

    kind: Kind
    message: str
    first: Offset
    last: Offset
    count: int = 0


class EventFindings:
    """Findings about events, which are checked in offset order. Takes a few numbers of memory for
    each keyframe."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Kind, str], _Group] = {}
        self._seen: dict[RunId, set[KeyframeId]] = {}
        self._stamps = RunStamps()
        self._gaps = ReportedGaps()
        self._commands: dict[str, tuple[Offset, bytes]] = {}
        self._logged_ns = 0

    def begin_segment(self, *, imported: bool) -> None:
        """Begin the next segment. Events of an imported one may be older than those before it."""
        if imported:
            self._logged_ns = 0

    def check(self, event: Event) -> None:
        """Check the next event."""
        if event.key != system_events.MAP_KEY:
            if event.logged_ns < self._logged_ns:
                self._add("time", "", event.offset, _BACKWARDS)
            self._logged_ns = event.logged_ns
        if event.key == system_events.LOSS_KEY:
            self._check_loss(event)
        elif event.key == system_events.COMMAND_KEY:
            self._check_command(event)
        elif event.key in _READERS:
            self._read(_READERS[event.key], event)
        elif event.is_envelope:
            self._check_envelope(event)

    def _check_command(self, event: Event) -> None:
        command = self._read(parse_command, event)
        if command is None:
            return
        digest = hashlib.sha256(encode_command(command)).digest()
        command_id = command.command_id
        first, known = self._commands.setdefault(command_id, (event.offset, digest))
        if known != digest:
            what = (
                f"command {visible(command_id)} has the id of another one, at offset {first}, and "
                "does not count"
            )
            self._add("schema", what, event.offset, what)

    def _check_loss(self, event: Event) -> None:
        loss = self._read(system_events.Loss.model_validate_json, event)
        gap = None if loss is None else gap_of(loss)
        if gap is not None:
            self._gaps.add_report(event.offset, gap)
        elif loss is not None:
            what = _LOST[loss.cause].format(loss.publisher)
            self._add("loss", what, event.offset, what, loss.count)

    def _read(self, read: Callable[[bytes], T], event: Event) -> T | None:
        """What ``read`` makes of the payload; None, and a finding, if it cannot."""
        try:
            return read(event.payload)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
        except (InvalidCommand, InvalidEmbeddings, InvalidMap) as error:
            reason = str(error)
        what = f"{event.key} event cannot be read: {reason}"
        self._add("schema", what, event.offset, what)
        return None

    def _check_envelope(self, event: Event) -> None:
        outcome = read_envelope(event)
        if not isinstance(outcome, Accepted):
            self._add(
                "schema",
                f"{event.key} {outcome.reason}",
                event.offset,
                f"event on {event.key} is no envelope: {outcome.reason}",
            )
            return
        run_id, keyframe_id = outcome.envelope.run_id, outcome.envelope.keyframe_id
        seen = self._seen.setdefault(run_id, set())
        if keyframe_id in seen:
            self._add(
                "duplicate", run_id, event.offset, f"keyframes of run {run_id} are recorded again"
            )
            return
        seen.add(keyframe_id)
        self._stamps.add(run_id, keyframe_id, event.stamp_ns, event.offset)
        if has_keyframe_id(event.version):  # a bare list names none
            self._gaps.add_keyframe(run_id, keyframe_id)

    def _add(self, kind: Kind, about: str, offset: Offset, message: str, count: int = 1) -> None:
        group = self._groups.setdefault((kind, about), _Group(kind, message, offset, offset))
        group.first = min(group.first, offset)
        group.last = max(group.last, offset)
        group.count += count

    def findings(self) -> Iterator[Finding]:
        """The findings by first offset. Call once, after all events."""
        for offset, message in self._stamps.findings():
            self._add("time", message, offset, message)
        for run_id, missing, first, last in self._gaps.still_open():
            what = _LOST["keyframe_gap"].format(run_id)
            self._add("loss", what, first, what, missing)
            self._add("loss", what, last, "", 0)
        for group in sorted(self._groups.values(), key=lambda g: g.first):
            yield Finding(
                group.kind,
                f"{group.message} ({group.count}, first at offset {group.first})",
                first_offset=group.first,
                last_offset=group.last,
                count=group.count,
            )
