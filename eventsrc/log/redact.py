"""Redaction: put tombstones in place of payloads, at the same offsets, and prove what changed.

An event that is redacted whole becomes one on ``mapfold/redacted``; of an event that keeps a part
of what it says the payload is replaced. Offsets, times and everything else stay. What changed is
written down in events on ``mapfold/redaction`` (`Redaction`), at most one for each segment and
`MOST_CHANGES`.

A log is redacted in steps, each of which may be the last before a kill:

1. New segments are written into ``LOG/.redaction``, with links to the others, so that the folder
   is the log as it will be. Until there is a journal in it, nothing has happened: the next
   redaction deletes it.
2. The journal is written: which segments are to be replaced, and the events to be appended. From
   here on the next writer of the log finishes a killed redaction: `Pending`.
3. Each segment is replaced under its name; then the events are appended. The journal then says
   that only copies elsewhere are left to be cleared, by who redacts.

A rewritten segment notes the hash that its successor names, so that the chain holds. `mapfold
log verify` proves that what is listed has the payloads that are listed, and that nothing else has
changed since.
"""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Annotated, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.base.machine import system_clock
from eventsrc.base.progress import reported
from eventsrc.base.text import advised
from eventsrc.envelope.model import ENVELOPE_VERSION, FIRST_OFFSET, Offset, Text
from eventsrc.envelope.system_events import REDACTED_KEY, REDACTION_KEY

from . import format as names
from . import mcap_records as _mcap
from .archive_place import place_locked, refuse_away
from .channels import key_channel, schema_of
from .durable_files import replace_durably, sync_directory, sync_file, write_all
from .event import Event, event_hash
from .lock import WriterLock
from .reader import LogReader, OnGap
from .seal import REPLACES, SegmentPlan, file_sha256, write_sealed
from .sealed_segment import SealedFile
from .segment import Unreadable

MOST_CHANGES: Final = 50_000
"""Bound of the changed events in one event on ``mapfold/redaction``."""
_SEGMENT: Final = re.compile(r"[0-9]{20}\.mcap")
_JOURNAL: Final = "journal.json"
_UNFINISHED: Final = "journal.new"


class Rewritten(NamedTuple):
    """What an event becomes: its new ``payload``, or if it is ``whole`` gone a tombstone."""

    payload: bytes
    whole: bool = False


Decide = Callable[[Event], Rewritten | None]
"""What an event becomes; None if it stays as it is."""


class Redaction(BaseModel):
    """The content of a ``mapfold/redaction`` event: what was changed in one segment, by whom.

    ``offsets`` are the changed events, ``was`` the SHA-256 of ``salt`` and the payload before,
    ``now`` that of the payload since. ``replaces_sha256`` is of the segment's file before.
    ``kept_sha256`` is the SHA-256 of the hashes, each with a newline, of all events of the segment
    that no redaction has changed; an event's hash is that of the JSON list of its offset, key, log
    time and stamp, a newline, and its payload. ``digest_before`` and ``digest_after`` are those of
    the map of the events before this one.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    redaction_id: Text
    issued_by: Text
    reason: str = ""
    selection: str
    base: Annotated[int, Field(ge=0)]
    following: Annotated[int, Field(ge=0)]
    replaces_sha256: str
    kept_sha256: str
    salt: str
    offsets: Annotated[tuple[int, ...], Field(max_length=MOST_CHANGES)]
    was: tuple[str, ...]
    now: tuple[str, ...]
    digest_before: str | None = None
    digest_after: str | None = None


class SegmentChange(NamedTuple):
    """What is changed in one segment, for its events on ``mapfold/redaction``."""

    base: Offset
    following: Offset
    replaces_sha256: str
    kept_sha256: str
    changed: list[tuple[Offset, str, str]]
    """Offset, salted hash of the payload before, hash of the payload since."""


def staging_folder(log: Path) -> Path:
    """Where a redaction of ``log`` is prepared: the log as it will be."""
    return log / ".redaction"


class Pending:
    """A redaction whose journal is there: under the writer's lock it is gone on with."""

    def __init__(self, log: Path) -> None:
        self._log = log
        path = staging_folder(log) / _JOURNAL
        try:
            document = json.loads(path.read_bytes())
            self._segments = [str(name) for name in document["segments"]]
            self._first, self._payloads = int(document["first"]), list(document["payloads"])
            self.is_recorded = bool(document["recorded"])
            self.due = [str(word) for word in document.get("due", ())]
            """The options that name the databases to be made again, without passwords."""
        except (ValueError, KeyError, TypeError) as error:
            raise LogDamaged(f"{path} cannot be read: {error}") from None
        if not all(map(_SEGMENT.fullmatch, self._segments)):
            raise LogDamaged(f"{path} names what is no segment")

    @classmethod
    def of(cls, log: Path) -> "Pending | None":
        """The redaction of ``log`` that is not finished; None if there is none."""
        return cls(log) if (staging_folder(log) / _JOURNAL).exists() else None

    def replace_segments(self) -> None:
        """Put the new segments in the place of the old ones; durable when this returns."""
        with place_locked(self._log):
            for name in self._segments:
                staged = staging_folder(self._log) / name
                if staged.is_file() and not staged.is_symlink():
                    staged.replace(self._log / name)
            sync_directory(self._log)

    def missing(self, next_offset: Offset) -> list[bytes]:
        """The events still to be appended to a log that ends at ``next_offset``."""
        if self.is_recorded:
            return []
        return [text.encode() for text in self._payloads[max(0, next_offset - self._first) :]]

    def note_recorded(self) -> None:
        """Write down that the log is as it should be, and copies elsewhere are to be cleared."""
        if not self.is_recorded:
            done = {"segments": [], "first": 0, "payloads": [], "recorded": 1, "due": self.due}
            _write_journal(self._log, done)
            self.is_recorded = True

    def finish(self) -> None:
        """Delete the journal: everything is cleared."""
        shutil.rmtree(staging_folder(self._log))
        sync_directory(self._log)


class Redactor:
    """A context manager that holds a log's lock: `stage`, then `commit`. Without the latter nothing
    has happened. Every segment of the log must be sealed. Raises LogBusy."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._lock = WriterLock(log, system_clock)
        self._folder = staging_folder(log)
        self._staged: list[str] = []
        try:
            self._delete_what_never_began()
        except BaseException:
            self._lock.release()
            raise

    def _delete_what_never_began(self) -> None:
        if Pending.of(self._log) is None and self._folder.exists():
            shutil.rmtree(self._folder)

    def __enter__(self) -> "Redactor":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            self._delete_what_never_began()
        finally:
            self._lock.release()

    def stage(self, decide: Decide, salt: bytes) -> list[SegmentChange]:
        """Write the changed segments; what is changed in each. Afterwards `staging_folder` can be
        read as a log."""
        segments = names.list_segments(self._log)
        refuse_away(self._log, segments)
        if any(not segment.sealed for segment in segments):
            raise LogError(f"{self._log} has a segment that is not sealed; try again")
        self._folder.mkdir()
        with LogReader(self._log) as reader:
            listed = changed_before(reader)
        found: list[SegmentChange] = []
        for index, segment in enumerate(reported(segments, "redacting", len(segments), "segments")):
            following = segments[index + 1] if index + 1 < len(segments) else None
            change = self._rewrite(segment, following, decide, salt, listed)
            if change is None:
                target = self._folder / segment.path.name
                target.symlink_to(Path("..") / segment.path.name)
            else:
                self._staged.append(segment.path.name)
                found.append(change)
        sync_directory(self._folder)
        return found

    def _rewrite(
        self,
        segment: names.SegmentPath,
        following: names.SegmentPath | None,
        decide: Decide,
        salt: bytes,
        listed: set[Offset],
    ) -> SegmentChange | None:
        """Write the segment as it will be; None if nothing in it changes."""
        file = SealedFile(segment.path, segment.base)
        try:
            with LogReader(self._log) as reader:
                events = reader.read(segment.base, file.next_offset)
                if all(e.key == REDACTED_KEY or decide(e) is None for e in events):
                    return None
            work = _Segment(self._log, file, decide, salt, listed)
            before = file_sha256(segment.path)
            named = None if following is None else _previous_of(following)
            notes = {**names.origin_notes(file.head), REPLACES: named or before}
            plan = SegmentPlan(
                self._log,
                file.head["log_id"],
                segment.base,
                file.head[names.PREVIOUS],
                file.next_offset,
                notes,
            )
            target = self._folder / segment.path.name
            write_sealed(plan, work.bodies(), target)
        finally:
            file.close()
        kept = work.kept.hexdigest()
        return SegmentChange(segment.base, file.next_offset, before, kept, work.changed)

    def commit(
        self, redactions: Sequence[Redaction], first: Offset, due: Sequence[str] = ()
    ) -> None:
        """Write the journal of what was staged: from here on the redaction goes on. ``first`` is
        the offset that the first of its events gets; ``due`` as `Pending.due`."""
        payloads = [each.model_dump_json(exclude_none=True) for each in redactions]
        begun = {"segments": self._staged, "first": first, "payloads": payloads, "recorded": 0}
        _write_journal(self._log, {**begun, "due": due})


def _write_journal(log: Path, document: dict[str, object]) -> None:
    folder = staging_folder(log)
    fd = os.open(folder / _UNFINISHED, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        write_all(fd, json.dumps(document).encode())
        sync_file(fd)
    finally:
        os.close(fd)
    replace_durably(folder / _UNFINISHED, folder / _JOURNAL)
    sync_directory(log)


def _previous_of(following: names.SegmentPath) -> str | None:
    return names.head_of(following.path, following.base).get(names.PREVIOUS)


class _Segment:
    """The bodies of a segment's chunks with the changes, and the hashes of what changed or not."""

    def __init__(
        self, log: Path, file: SealedFile, decide: Decide, salt: bytes, listed: set[Offset]
    ) -> None:
        self._file, self._decide, self._salt, self._listed = file, decide, salt, listed
        self._log = log
        self._tombstones: int | None = None
        self.changed: list[tuple[Offset, str, str]] = []
        self.kept = hashlib.sha256()

    def bodies(self) -> Iterator[bytes]:
        with LogReader(self._log) as reader:
            for chunk in self._file.chunks:
                body = self._file.read_chunk(chunk)
                events = {e.offset: e for e in reader.read(chunk.first, chunk.following)}
                yield self._changed(body, events)

    def _changed(self, body: bytes, events: dict[Offset, Event]) -> bytes:
        schemas, channels = _mcap.definitions(body)
        parts, has_tombstones = [_mcap.encode_all([*schemas, *channels])], False
        for channel, sequence, log_ns, stamp_ns, at, end in _mcap.iter_messages(body):
            offset = Offset(self._file.base + sequence)
            event, payload = events[offset], body[at:end]
            change = None if event.key == REDACTED_KEY else self._decide(event)
            if change is None:
                if offset not in self._listed:
                    self.kept.update(f"{event_hash(event)}\n".encode())
            else:
                was = hashlib.sha256(self._salt + payload).hexdigest()
                payload = change.payload
                self.changed.append((offset, was, hashlib.sha256(payload).hexdigest()))
                channel = self._tombstone_id() if change.whole else channel
                has_tombstones = has_tombstones or change.whole
            parts += (
                _mcap.encode_message_head(channel, sequence, log_ns, stamp_ns, len(payload)),
                payload,
            )
        return b"".join([self._channel() if has_tombstones else b"", *parts])

    def _tombstone_id(self) -> int:
        """The channel of tombstones: the segment's own if it has one, else a new one."""
        if self._tombstones is None:
            own = [c.id for c in self._file.channels.values() if c.topic == REDACTED_KEY]
            self._tombstones = own[0] if own else max(self._file.channels, default=0) + 1
        return self._tombstones

    def _channel(self) -> bytes:
        """The definition of the channel of tombstones."""
        ids = [each.schema_id for each in self._file.channels.values()]
        id_ = self._tombstone_id()
        if id_ in self._file.channels:
            return b""
        schema_id = max([*self._file.schemas, *ids, 0]) + 1
        name, text = schema_of(REDACTED_KEY)
        schema = _mcap.Schema(id=schema_id, name=name, encoding="jsonschema", data=text)
        return _mcap.encode_all(
            [schema, key_channel(id_, schema_id, REDACTED_KEY, ENVELOPE_VERSION)]
        )


def read_redactions(
    reader: LogReader, on_gap: OnGap | None = None
) -> list[tuple[Offset, Redaction]]:
    """The events on ``mapfold/redaction``. Raises LogDamaged where one cannot be read, or calls
    ``on_gap``."""
    found = []
    for event in reader.read(keys={REDACTION_KEY}, on_gap=on_gap):
        try:
            found.append((event.offset, Redaction.model_validate_json(event.payload)))
        except ValidationError:
            why = f"the event at offset {event.offset} does not say what was redacted"
            if on_gap is None:
                raise LogDamaged(f"{reader.path}: {why}") from None
            on_gap(Unreadable(event.offset, event.offset, why))
    return found


def changed_before(reader: LogReader) -> set[Offset]:
    """The offsets that redactions of a log have changed."""
    return {Offset(o) for _, each in read_redactions(reader) for o in each.offsets}


def unfinished(log: Path) -> str | None:
    """What to do about a redaction that is not finished; None if there is none."""
    if (pending := Pending.of(log)) is None:
        return None
    again = advised("log", "redact", log, "--resume", *pending.due)
    return f"{log}: a redaction is not finished; copies of what it erases may remain: run `{again}`"


def redactions_of(changes: Iterable[SegmentChange], about: dict[str, object]) -> list[Redaction]:
    """The events on ``mapfold/redaction`` of what was staged; ``about`` has the fields that all
    share."""
    made = []
    for segment in changes:
        for start in range(0, len(segment.changed), MOST_CHANGES):
            part = segment.changed[start : start + MOST_CHANGES]
            made.append(
                Redaction.model_validate(
                    {
                        **about,
                        "base": segment.base,
                        "following": segment.following,
                        "replaces_sha256": segment.replaces_sha256,
                        "kept_sha256": segment.kept_sha256,
                        "offsets": [offset for offset, _, _ in part],
                        "was": [was for _, was, _ in part],
                        "now": [now for _, _, now in part],
                    }
                )
            )
    return made


def end_of(log: Path) -> Offset:
    """The offset behind the last event of a log."""
    with LogReader(log) as reader:
        return reader.next_offset if reader.segments else FIRST_OFFSET
