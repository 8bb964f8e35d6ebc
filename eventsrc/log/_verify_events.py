"""Looking at the events of a log one by one, for what no checksum can tell."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.ingest import Accepted
from eventsrc.losses import gap_of
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload, is_system_key
from eventsrc.upcast import read_envelope

from ._verify_gaps import ReportedGaps
from ._verify_stamps import RunStamps
from .event import Event
from .findings import Finding, Kind

Model = TypeVar("Model", bound=BaseModel)

_BACKWARDS = "logged_ns runs backwards: the clock was set back, or older recordings were imported"


@dataclass(slots=True)
class _Group:
    """Like findings, told as one."""

    kind: Kind
    message: str
    first: int
    last: int
    count: int = 0


class EventFindings:
    """Takes events in offset order; memory is a few numbers for each keyframe."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Kind, str], _Group] = {}
        self._seen: dict[str, set[int]] = {}
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

    def _add(self, kind: Kind, about: str, offset: int, message: str, count: int = 1) -> None:
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
