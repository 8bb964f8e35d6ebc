"""Import files into a log, with the same validation as recording.

An import only appends, and passes over what is in the log already (`known_log`), so that an import
that was interrupted can be run again.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace

from pydantic import ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import encode_command
from eventsrc.envelope.dropped_classes import ClassDropper, DropClasses
from eventsrc.envelope.forms import BARE_LIST_VERSION
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.ingest import DEFAULT_MAX_PAYLOAD_BYTES, CheckedEnvelope, Rejected
from eventsrc.envelope.model import Offset, RunId, has_keyframe_id
from eventsrc.envelope.occupancy_map import InvalidMap, OccupancyMap, decode_map
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    DROP_KEY,
    EMBEDDINGS_KEY,
    LOSS_KEY,
    MAP_KEY,
    REJECTED_KEY,
    ROS_KEY,
)
from eventsrc.log import FsyncPolicy, LogWriter, MessageFormat
from eventsrc.record.append import (
    Checked,
    NewMap,
    check_payloads,
    checked_event,
    rejected_event,
    without_dropped,
)

from .bag_streams import BagOptions
from .known_log import (
    IS_KNOWN,
    ImportReport,
    KnownEvents,
    LogCommands,
    NotTakenOver,
    SourceCommands,
)
from .opening import open_source
from .ros_bags import BagReport, RosBag
from .sources import (
    NO_ENVELOPES,
    NOT_CHOSEN,
    ImportedMessage,
    LogTimes,
    PassedOver,
    Source,
    TopicChoice,
    looks_like_envelope,
    not_dropped,
)

DEFAULT_KEY = "tb/detections"
IMPORT_FSYNC = FsyncPolicy(interval_ns=500_000_000, max_events=4096)
"""Larger commits than a recorder's: the source can be read again after a crash."""

ALL_TOPICS = TopicChoice()
_PROGRESS_EVERY = 64
_DEFAULT_BAGS = BagOptions()
_NO_COMMANDS = LogCommands()

Progress = Callable[[Source], None]
OnReject = Callable[[str, str], None]
"""Called with the place of a message (``run.jsonl: line 17``) and the reason of its rejection."""


class ImportInterrupted(KeyboardInterrupt):
    """An import was ended by Ctrl-C. ``report`` counts what is synced to the log; ``place`` is the
    place of the last message (``line 17 of run.jsonl``), None without any."""

    def __init__(self, report: ImportReport, place: str | None) -> None:
        super().__init__()
        self.report = report
        self.place = place


def import_files(
    writer: LogWriter,
    names: Sequence[str],
    *,
    key: str = DEFAULT_KEY,
    progress: Progress | None = None,
    on_reject: OnReject | None = None,
    step: AbstractContextManager[object] | None = None,
    given_map: OccupancyMap | None = None,
    commands: LogCommands = _NO_COMMANDS,
    topics: TopicChoice = ALL_TOPICS,
    bags: BagOptions = _DEFAULT_BAGS,
    ledger: GapLedger[RunId] | None = None,
) -> ImportReport:
    """Append what ``commands`` begin with and ``given_map``, if there are such, then every message
    of ``names`` in order, but for what the log has already. Messages without a key get ``key``.
    Without a time of receipt the log time of an envelope is its stamp (`LogTimes`), that of
    anything else the log time of the message before it.

    Messages of topics that are not among ``topics`` are passed over. So are the messages of an MCAP
    file that no importer reads and, unless ``topics`` chooses them, those that do not look like
    envelopes. ``bags`` has the choices for bags of ROS 2. Settings and map are appended when the
    first message was read. A new log that begins with none begins with those that its first source
    begins with. ``ledger`` is the gap ledger of the log, to which new keyframes are added; without
    one nothing counts as in the log already.

    ``step`` is entered for each message; one that defers Ctrl-C makes `ImportInterrupted` exact.
    Raises MisuseError and MapfoldError for files that cannot be read.
    """
    refused = on_reject or (lambda _place, _reason: None)
    given = [] if commands.begins is None else [(COMMAND_KEY, encode_command(commands.begins))]
    given += [(DROP_KEY, commands.drops.encode())] if commands.drops else []
    given += [] if given_map is None else [(MAP_KEY, given_map.encode())]
    dropper = ClassDropper[ImportedMessage](commands.dropped, commands.labels)
    known = KnownEvents(writer.path, writer.next_offset, ledger)
    of_source = SourceCommands(writer.path, commands)
    run = _Import(writer, key, refused, topics, ledger, known, of_source, given, dropper)
    try:
        with ExitStack() as files:
            for name in names:
                source = open_source(name, files, bags)
                if topics and isinstance(source, RosBag):
                    raise MisuseError(
                        f"{name}: --topic does not choose what is used of a bag of ROS 2; "
                        "--detections, --grid and so on do"
                    )
                run.begins = True
                for number, message in enumerate(source.messages()):
                    with step or nullcontext():
                        run.append(source, message)
                    if progress is not None and number % _PROGRESS_EVERY == 0:
                        progress(source)
                run.skipped += source.skipped
                if isinstance(source, RosBag) and source.report is not None:
                    run.bags.append(source.report)
        run.append_given(None)
    except KeyboardInterrupt:
        raise ImportInterrupted(run.report(), run.place) from None
    return run.report()


@dataclass(slots=True)
class _Import:
    """What has been appended, and the place of the last message."""

    writer: LogWriter
    key: str
    on_reject: OnReject
    topics: TopicChoice
    ledger: GapLedger[RunId] | None
    known: KnownEvents
    commands: SourceCommands
    given: list[tuple[str, bytes]]
    """Keys and payloads that are appended before the first message."""
    dropper: ClassDropper[ImportedMessage]
    begins: bool = False
    """Whether no message of the source had a time yet. If log times go back there, a new segment
    is begun."""
    accepted: int = 0
    rejected: int = 0
    system: int = 0
    skipped: int = 0
    maps: int = 0
    verbatim: int = 0
    classes: set[bool] = field(default_factory=set)
    """Whether the classes of an accepted envelope are numbers, of all that have classes."""
    bags: list[BagReport] = field(default_factory=list)
    passed_over: Counter[tuple[str, str]] = field(default_factory=Counter)
    times: LogTimes = field(default_factory=LogTimes)
    logged_ns: int | None = None
    last: tuple[Source, int | None] | None = None
    first_offset: Offset = field(init=False)
    repeated_before: int = field(init=False)

    def __post_init__(self) -> None:
        self.first_offset = self.writer.next_offset
        self.repeated_before = 0 if self.ledger is None else self.ledger.duplicates

    def append(self, source: Source, message: ImportedMessage) -> None:
        """Append one message: a system event or a verbatim message unchanged, anything else after
        validation; all without what the log drops."""
        for each in not_dropped(message, self.dropper) if self.dropper else (message,):
            self._append(source, each)

    def _append(self, source: Source, message: ImportedMessage) -> None:
        topic = message.key or self.key
        self.begins |= message.begins
        if not self.topics.takes(topic):
            self.passed_over[topic, NOT_CHOSEN] += 1
        elif message.refused is not None:
            self._append_refused(source, message, message.refused)
        elif message.unread is not None:
            self.passed_over[topic, message.unread] += 1
        elif self._has(topic, message):
            self.passed_over[topic, IS_KNOWN] += 1
        elif message.form is not None:
            self._append_verbatim(message, message.form)
        elif message.key in (REJECTED_KEY, LOSS_KEY, ROS_KEY, EMBEDDINGS_KEY):
            self._append_system_event(message.key or "", message)
        elif message.key == MAP_KEY:
            self._append_map_event(source, message)
        elif message.key == COMMAND_KEY:
            self._append_command(source, message)
        elif message.key == DROP_KEY:
            self._append_drop(source, message)
        else:
            self._append_envelope(source, message)
        self.last = source, source.at

    def append_given(self, next_ns: int | None) -> None:
        """Append what was given, once. ``next_ns`` is the log time of the message after it, which
        it gets too unless that is in the future, so that log times do not go back."""
        now_ns = self.writer.now_ns() if self.given else 0
        logged_ns = now_ns if next_ns is None else min(now_ns, next_ns)
        for key, payload in self.given:
            self.writer.append(key, payload, logged_ns=logged_ns)
            self.maps += key == MAP_KEY
        self.given = []

    def _time_of(self, message: ImportedMessage, keyframe: tuple[RunId, int] | None = None) -> int:
        """The log time of the next message, of which ``keyframe`` is run and stamp. Appends
        what was given before it."""
        if message.logged_ns is not None:
            logged_ns = self.times.add(message.logged_ns)
        elif keyframe is not None:
            logged_ns = self.times.add_stamped(*keyframe)
        elif self.times.last_ns is not None:
            logged_ns = self.times.last_ns
        else:
            logged_ns = self.writer.now_ns()
        if self.begins and self.logged_ns is not None and logged_ns < self.logged_ns:
            self.writer.begin_segment()
        if message.logged_ns is not None or keyframe is not None:
            self.begins = False
        self.logged_ns = logged_ns
        self.append_given(logged_ns)
        return logged_ns

    def _append_map_event(self, source: Source, message: ImportedMessage) -> None:
        """Append a map event of another log, or its rejection."""
        try:
            decode_map(message.payload)
        except InvalidMap as error:
            self._reject(source, message, str(error))
        else:
            self._append_system_event(MAP_KEY, message)
            self.maps += 1

    def _has(self, topic: str, message: ImportedMessage) -> bool:
        """Whether the log has a verbatim message, or an event of mapfold's own, already. Commands
        are known by their ids."""
        is_own = message.key in (REJECTED_KEY, LOSS_KEY, ROS_KEY, EMBEDDINGS_KEY, MAP_KEY)
        if not (is_own or message.form is not None):
            return False
        return self.known.has(topic, message.payload, message.logged_ns)

    def _append_command(self, source: Source, message: ImportedMessage) -> None:
        """Append a command of another log, its rejection, or nothing."""
        try:
            known = self.commands.take(message.payload, is_first=self.writer.next_offset == 0)
        except NotTakenOver as refused:
            self._reject(source, message, str(refused))
            return
        if known:
            self.passed_over[COMMAND_KEY, known] += 1
        else:
            self._append_system_event(COMMAND_KEY, message)

    def _append_drop(self, source: Source, message: ImportedMessage) -> None:
        """Append that another log drops classes, which this one then does, too."""
        try:
            is_new = self.dropper.add(DropClasses.model_validate_json(message.payload).classes)
        except ValidationError as error:
            self._reject(source, message, error.errors()[0]["msg"])
            return
        if is_new:
            self._append_system_event(DROP_KEY, message)
        else:
            self.passed_over[DROP_KEY, IS_KNOWN] += 1

    def _append_refused(self, source: Source, message: ImportedMessage, reason: str) -> None:
        if self._is_for_others(message):
            self.passed_over[message.key or self.key, NO_ENVELOPES] += 1
        else:
            self._reject(source, message, reason)

    def _reject(self, source: Source, message: ImportedMessage, reason: str) -> None:
        payload = message.payload if message.excerpt is None else message.excerpt
        key, logged_ns = message.key or self.key, self._time_of(message)
        kept, why = self.dropper.kept_of(payload), self.dropper.reason(reason)
        self.writer.append_all([rejected_event(key, kept, why, logged_ns)])
        self._count_rejected(source, reason)

    def _count_rejected(self, source: Source, reason: str) -> None:
        self.rejected += 1
        self.on_reject(f"{source.name}: {source.unit} {source.at}", reason)

    def _append_system_event(self, key: str, message: ImportedMessage) -> None:
        logged_ns = self._time_of(message)
        self.writer.append(key, message.payload, logged_ns=logged_ns, stamp_ns=message.stamp_ns)
        self.system += 1

    def _append_verbatim(self, message: ImportedMessage, form: MessageFormat) -> None:
        self.writer.append(
            message.key or self.key,
            message.payload,
            logged_ns=self._time_of(message),
            stamp_ns=message.stamp_ns,
            form=form,
        )
        self.verbatim += 1

    def _append_envelope(self, source: Source, message: ImportedMessage) -> None:
        key = message.key or self.key
        (whole,) = check_payloads(
            [(key, message.payload)],
            first=self.writer.next_offset,
            logged_ns=self.writer.now_ns() if message.logged_ns is None else message.logged_ns,
            max_bytes=DEFAULT_MAX_PAYLOAD_BYTES,
            version=BARE_LIST_VERSION if message.version == BARE_LIST_VERSION else None,
            are_grids=message.is_grid,
        )
        checked, stripped = without_dropped(message.payload, whole, self.dropper)
        self._append_checked(source, replace(message, payload=stripped.payload), checked)
        for crop in self.dropper.release(stripped):
            self._append(source, replace(crop, logged_ns=message.logged_ns))

    def _append_checked(self, source: Source, message: ImportedMessage, checked: Checked) -> None:
        key, result, stamp_ns = message.key or self.key, checked.result, checked.stamp_ns
        if isinstance(result, Rejected) and self._is_for_others(message):
            self.passed_over[key, NO_ENVELOPES] += 1
            return
        if self._has_checked(key, message, checked):
            self.passed_over[key, IS_KNOWN] += 1
            return
        keyframe = None
        if isinstance(result, CheckedEnvelope) and stamp_ns is not None:
            keyframe = result.run_id, stamp_ns
        logged_ns = self._time_of(message, keyframe)
        of_message = key, message.payload, checked, logged_ns, self.dropper
        self.writer.append_all([checked_event(*of_message)])
        if isinstance(result, Rejected):
            self._count_rejected(source, result.reason)
        elif isinstance(result, NewMap):
            self.maps += 1
        else:
            self.accepted += 1
            if result.numbered is not None:
                self.classes.add(result.numbered)
            if self.ledger is not None and has_keyframe_id(checked.version):
                self.ledger.record(result.run_id, result.keyframe_id, 0)

    def _has_checked(self, key: str, message: ImportedMessage, checked: Checked) -> bool:
        """Whether the log has what is to be appended for an accepted payload already."""
        result = checked.result
        if isinstance(result, Rejected):
            return False
        if isinstance(result, NewMap):
            return self.known.has(MAP_KEY, result.event, message.logged_ns)
        if has_keyframe_id(checked.version):
            return self.known.has_envelope(result, message.payload)
        return self.known.has(key, message.payload, message.logged_ns)

    def _is_for_others(self, message: ImportedMessage) -> bool:
        """Whether to pass over a message that is no envelope and does not look like one."""
        return message.is_foreign and not self.topics and not looks_like_envelope(message.payload)

    @property
    def place(self) -> str | None:
        """The last message's place, such as ``line 17 of run.jsonl``."""
        if self.last is None:
            return None
        source, at = self.last
        return f"{source.unit} {at} of {source.name}"

    def report(self) -> ImportReport:
        """Sync the log and count what was appended."""
        skipped = self.skipped + self.passed_over.total()
        counts = (self.accepted, self.rejected, self.system, skipped)
        return ImportReport(
            *counts,
            self.first_offset,
            self.writer.sync(),
            self.maps,
            self.verbatim,
            tuple(PassedOver(*what, count) for what, count in self.passed_over.items()),
            tuple(self.bags),
            None if self.ledger is None else self.ledger.duplicates - self.repeated_before,
            self.commands.began,
            self.classes == {True} and not self.commands.names_labels,
            self.dropper.counts,
        )
