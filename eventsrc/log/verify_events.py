"""Looking at the events of a log one by one, for what no checksum can tell.

Which of the gaps that a log reports are still open: a late keyframe closes its gap, be it before
or after somebody looked. A gap ledger is folded over the log, as `log info` and `status` do.

Oddities in the stamps of runs.

A robot counts its keyframes in the order in which it took them, so its stamps should grow with
their numbers, in whatever order they reached the log: one that was sent again late is no oddity.
Odd is a keyframe stamped before the one it follows (the robot's clock was set back), and one
stamped more than a day after it (a clock that was set while the robot drove: until then its stamps
were from another year). That stamps are far from when they were logged is not odd: runs are
imported long after, and robots have clocks of their own.

What `mapfold log verify` may find.
"""

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from eventsrc.envelope import ENVELOPE_VERSION, KeyframeId, Offset, RunId
from eventsrc.gaps import Gap, GapLedger, gap_of
from eventsrc.ingest import Accepted
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload, is_system_key
from eventsrc.upcast import read_envelope

from .event import Event


class OpenGaps(NamedTuple):
    """How many keyframes of a run were reported missing and never came, and the offsets of the
    first and the last event that reports any of them."""

    run_id: RunId
    missing: int
    first_offset: Offset
    last_offset: Offset


class ReportedGaps:
    """Takes keyframes and reported gaps in offset order."""

    def __init__(self) -> None:
        self._ledger: GapLedger[RunId] = GapLedger()
        self._reports: defaultdict[RunId, list[tuple[Offset, Gap[RunId]]]] = defaultdict(list)

    def take_keyframe(self, run_id: RunId, keyframe_id: KeyframeId) -> None:
        """One that is recorded."""
        self._ledger.record(run_id, keyframe_id, 0)

    def take_report(self, offset: Offset, gap: Gap[RunId]) -> None:
        """The loss event at ``offset`` reports ``gap``."""
        self._reports[gap.run_id].append((offset, gap))
        self._ledger.assume(gap, 0)

    def still_open(self) -> Iterator[OpenGaps]:
        """By run, what is still missing."""
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


class StampOddity(NamedTuple):
    """``offset`` of a keyframe and what is odd about its stamp."""

    offset: Offset
    message: str


@dataclass(slots=True)
class _Run:
    keyframes: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))


class RunStamps:
    """Takes each keyframe once, in offset order; three numbers of memory for each."""

    def __init__(self) -> None:
        self._runs: dict[RunId, _Run] = {}

    def take(self, run_id: RunId, keyframe_id: KeyframeId, stamp_ns: int, offset: Offset) -> None:
        """The next keyframe in the log."""
        run = self._runs.setdefault(run_id, _Run())
        run.keyframes.append(keyframe_id)
        run.stamps.append(stamp_ns)
        run.offsets.append(offset)

    def oddities(self) -> Iterator[StampOddity]:
        """What is odd, run by run in the order of keyframes."""
        for run_id, run in self._runs.items():
            order = sorted(range(len(run.keyframes)), key=run.keyframes.__getitem__)
            for before, this in pairwise(order):
                step_ns = run.stamps[this] - run.stamps[before]
                if step_ns < 0:
                    yield StampOddity(
                        Offset(run.offsets[this]), f"stamps of run {run_id} run backwards"
                    )
                elif step_ns > JUMP_NS:
                    yield StampOddity(
                        Offset(run.offsets[this]), f"stamps of run {run_id} jump by more than a day"
                    )


Kind = Literal["crc", "gap", "chain", "log_id", "torn", "schema", "duplicate", "time", "loss"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it should be.

    ``first_offset`` and ``last_offset`` are the first and last event it concerns, None where it
    concerns none; ``count`` is how many.

    crc        bytes differ from what was written
    gap        events that were recorded are not there
    chain      a segment is not the one its successor was written after
    log_id     a segment belongs to another log
    torn       an end that was being written when its writer died; never recorded
    schema     an event the fold cannot read
    duplicate  a keyframe that stands more than once (the fold takes the first)
    time       a clock that ran backwards, or was set while a robot drove
    loss       what the log says never came and did not come late either, or was lost to rot
    """

    kind: Kind
    message: str
    segment: str | None = None
    first_offset: Offset | None = None
    last_offset: Offset | None = None
    count: int = 1


Model = TypeVar("Model", bound=BaseModel)

_BACKWARDS = "logged_ns runs backwards: the clock was set back, or older recordings were imported"


@dataclass(slots=True)
class _Group:
    """Like findings, told as one."""

    kind: Kind
    message: str
    first: Offset
    last: Offset
    count: int = 0


class EventFindings:
    """Takes events in offset order; memory is a few numbers for each keyframe."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Kind, str], _Group] = {}
        self._seen: dict[RunId, set[KeyframeId]] = {}
        self._stamps = RunStamps()
        self._gaps = ReportedGaps()
        self._logged_ns = 0

    def take(self, event: Event) -> None:
        """Look at the next event."""
        if event.logged_ns < self._logged_ns:
            self._add("time", "", event.offset, _BACKWARDS)
        self._logged_ns = event.logged_ns
        if event.key == LOSS_KEY:
            self._take_loss(event)
        elif event.key == REJECTED_KEY:
            self._parse(RejectedPayload, event)
        elif not is_system_key(event.key):
            self._take_envelope(event)

    def _take_loss(self, event: Event) -> None:
        loss = self._parse(Loss, event)
        gap = None if loss is None else gap_of(loss)
        if gap is not None:
            self._gaps.take_report(event.offset, gap)
        elif loss is not None:
            what = f"{loss.cause} of {loss.publisher}"
            self._add("loss", what, event.offset, f"lost by {what}", loss.count)

    def _parse(self, model: type[Model], event: Event) -> Model | None:
        try:
            return model.model_validate_json(event.payload)
        except ValidationError as error:
            what = f"{event.key} event cannot be read: {error.errors()[0]['msg']}"
            self._add("schema", what, event.offset, what)
            return None

    def _take_envelope(self, event: Event) -> None:
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
            self._add("duplicate", run_id, event.offset, f"keyframes of run {run_id} stand again")
            return
        seen.add(keyframe_id)
        self._stamps.take(run_id, keyframe_id, event.stamp_ns, event.offset)
        if event.version == ENVELOPE_VERSION:  # older ones count no keyframes
            self._gaps.take_keyframe(run_id, keyframe_id)

    def _add(self, kind: Kind, about: str, offset: Offset, message: str, count: int = 1) -> None:
        group = self._groups.setdefault((kind, about), _Group(kind, message, offset, offset))
        group.first = min(group.first, offset)
        group.last = max(group.last, offset)
        group.count += count

    def findings(self) -> Iterator[Finding]:
        """What was found, by first offset. To be asked once, when all events were taken."""
        for offset, oddity in self._stamps.oddities():
            self._add("time", oddity, offset, oddity)
        for run_id, missing, first, last in self._gaps.still_open():
            what = f"keyframe_gap of {run_id}"
            self._add("loss", what, first, f"lost by {what}", missing)
            self._add("loss", what, last, "", 0)
        for group in sorted(self._groups.values(), key=lambda g: g.first):
            yield Finding(
                group.kind,
                f"{group.message} ({group.count}, first at offset {group.first})",
                first_offset=group.first,
                last_offset=group.last,
                count=group.count,
            )
