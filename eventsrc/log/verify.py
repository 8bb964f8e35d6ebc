"""Verification of a log (`mapfold log verify`): read every byte and report everything wrong.

In the files: magic, checksums, hash chain, dense offsets, torn ends. In the events, see
`verify_events`: invalid payloads, duplicate keyframes, clocks that ran backwards, losses.

An archive is verified by its manifest, segment by segment, without the log.
"""

import hashlib
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from eventsrc.base.errors import ArchiveError, LogDamaged, LogError, NoSuchObject, NotALog
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import REDACTED_KEY, REDACTION_KEY

from . import format as names
from .archive import SEGMENTS, Archive, ManifestEntry, chain_faults
from .away import fetched_whole, stand_in_for
from .event import event_hash
from .lock import is_held
from .log_identity import CarriedId, own_log_id
from .reader import LogReader
from .redact import Redaction, read_redactions, unfinished
from .scan import scan_active, scan_sealed, scanned_events
from .seal import NO_PREVIOUS, REPLACES
from .sealed_end import InvalidSealedEnd, SealedEnd, read_sealed_end, sealed_end, segments_left
from .sealed_segment import check_sealed
from .segment import Scan
from .verify_events import EventFindings, Finding, Kind


class Redacted(NamedTuple):
    """One redaction: its id, who issued it and why, and how many payloads it changed."""

    redaction_id: str
    issued_by: str
    reason: str
    selection: str
    payloads: int


class Proof(NamedTuple):
    """The redactions of a log, and what contradicts them: offset and text."""

    redactions: tuple[Redacted, ...]
    faults: tuple[tuple[Offset, str], ...]


def check(reader: LogReader) -> Proof:
    """Prove the redactions of a log: payloads are those that are listed, and of each segment
    nothing else has changed since its last redaction."""
    known = read_redactions(reader, lambda _: None)
    by_id: dict[str, Redacted] = {}
    now: dict[Offset, str] = {}
    last: dict[Offset, tuple[str, str]] = {}
    for _, each in known:
        before = by_id.get(each.redaction_id)
        count = len(each.offsets) + (0 if before is None else before.payloads)
        about = each.redaction_id, each.issued_by, each.reason, each.selection
        by_id[each.redaction_id] = Redacted(*about, count)
        now.update(zip(map(Offset, each.offsets), each.now, strict=False))
        last[Offset(each.base)] = each.kept_sha256, each.redaction_id
    faults: list[tuple[Offset, str]] = []
    kept: defaultdict[Offset, hashlib._Hash] = defaultdict(hashlib.sha256)
    for base, end in _spans(known):
        for event in reader.read(base, end, on_gap=lambda _: None):
            if event.offset in now:
                if hashlib.sha256(event.payload).hexdigest() != now[event.offset]:
                    text = "the payload is not the one that the redaction put there"
                    faults.append((event.offset, text))
            else:
                kept[base].update(f"{event_hash(event)}\n".encode())
    for base in sorted(last):
        expected, redaction_id = last[base]
        if kept[base].hexdigest() != expected:
            text = f"events that redaction {redaction_id} left as they were have changed since"
            faults.append((base, text))
    tombstones = reader.read(keys={REDACTED_KEY}, on_gap=lambda _: None)
    unlisted = "a tombstone that no redaction lists"
    faults += [(event.offset, unlisted) for event in tombstones if event.offset not in now]
    return Proof(tuple(by_id.values()), tuple(sorted(faults)))


def _spans(known: Iterable[tuple[Offset, Redaction]]) -> list[tuple[Offset, Offset]]:
    return sorted({(Offset(each.base), Offset(each.following)) for _, each in known})


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of `verify_log`: how much was read, and the findings."""

    path: Path
    log_id: str | None
    segments: int
    events: int
    size_bytes: int
    findings: tuple[Finding, ...]
    redactions: tuple[Redacted, ...] = ()
    """What was erased, by whom and why."""


def verify_log(log: Path) -> Verification:
    """Verify a log. Raises LogNotFound, NotALog, or LogError if the disk cannot be read."""
    before: list[names.SegmentPath] = []
    while True:
        end = sealed_end(log)  # before the folder is listed: a writer may be active
        segments = segments_left(log)
        try:
            return _Verifier(log, segments, end).run()
        except OSError as error:
            sealed_meanwhile = isinstance(error, FileNotFoundError) and segments != before
            if not sealed_meanwhile:
                place, reason = error.filename or log, error.strerror or error
                raise LogError(f"{place}: {reason}; check its rights and its disk") from error
            before = segments


class _Verifier:
    def __init__(self, log: Path, segments: list[names.SegmentPath], end: SealedEnd | None) -> None:
        self._log = log
        self._segments = segments
        self._has_writer = is_held(log)
        self._has_redactions = False
        self._found: list[Finding] = []
        self._events = EventFindings()
        self._log_id = _log_id_of(segments, end)
        self._end = end if end is not None and end.log_id == self._log_id else None
        self._next_offset = FIRST_OFFSET
        self._count = 0
        self._bytes_done = 0
        self._bytes = 2 * sum(_size_of(segment) for segment in segments)
        """Each segment is read twice: its chunks, then its events."""
        self._expected_hashes: set[str] = {NO_PREVIOUS}
        """Hashes that the next segment may name for the one before it; empty if any."""

    def run(self) -> Verification:
        size = 0
        for index, segment in enumerate(self._segments):
            if index + 1 < len(self._segments):
                reach: Offset | None = self._segments[index + 1].base
            else:
                reach = None if self._end is None else self._end.reach(segment.base)
            size += self._verify_segment(segment, reach)
        self._check_sealed_end()
        for path in names.not_files(self._log):
            self._add("crc", "is no file, but a folder, a pipe or a device", path.name)
        redactions = self._check_redactions()
        report_progress("verifying", 1, 1, "MB")
        return Verification(
            self._log,
            self._log_id,
            len(self._segments),
            self._count,
            size,
            (*self._found, *self._events.findings()),
            redactions,
        )

    def _check_redactions(self) -> tuple[Redacted, ...]:
        """Prove what the log says was erased, and report what contradicts it."""
        if (text := unfinished(self._log)) is not None:
            self._found.append(Finding("redaction", text))
        if not self._has_redactions:
            return ()
        try:
            with LogReader(self._log) as reader:
                proof = check(reader)
        except LogDamaged:
            return ()  # reported before
        for offset, text in proof.faults:
            at = next((s for s in reversed(self._segments) if s.base <= offset), None)
            name = None if at is None else at.path.name
            self._found.append(Finding("redaction", text, name, offset, offset))
        return proof.redactions

    def _verify_segment(self, segment: names.SegmentPath, reach: Offset | None) -> int:
        """Verify one segment, which ends at ``reach`` if that is known; its size in bytes."""
        self._report(self._bytes_done)
        if not segment.sealed and not segment.path.exists():  # sealed since the folder was listed
            segment = names.SegmentPath(
                names.segment_path(self._log, segment.base, names.SEALED), segment.base, True
            )
        if segment.away:
            with fetched_whole(segment) as path:
                here = names.SegmentPath(path, segment.base, True)
                return self._verify_segment(here, reach)
        name = segment.path.name
        if segment.base != self._next_offset:
            last = max(Offset(segment.base - 1), self._next_offset)
            self._add(
                "gap", "events before this segment are missing", name, self._next_offset, last
            )
        head = self._check_head(segment)
        if head is None:
            self._skip_segment(segment, reach)
            return segment.path.stat().st_size
        if segment.sealed:
            scan = scan_sealed(segment.path, segment.base, reach)
            self._check_file(segment, scan, head)
        else:
            scan = scan_active(segment.path, segment.base)
            if reach is not None:
                scan.add_gap_until(reach)
            self._check_end(name, scan)
            self._expected_hashes = set()  # it has no hash before it is sealed
        for first, last in scan.gaps:
            self._add("gap", "recorded events cannot be read", name, first, last)
        self._events.begin_segment(imported=names.IMPORTED in head)
        size = segment.path.stat().st_size
        self._bytes_done += size
        self._verify_events(segment, scan)
        self._bytes_done += size
        self._next_offset = scan.next_offset
        return size

    def _check_sealed_end(self) -> None:
        """Report sealed segments that are missing at the end, and a `SealedEnd` that says nothing
        about this log."""
        if self._end is not None and self._end.following > self._next_offset:
            first, last = self._next_offset, Offset(self._end.following - 1)
            self._add(
                "gap", "segments that were sealed are not there", names.SEALED_END, first, last
            )
        repair = f"ignored; `{advised('log', 'recover', self._log)}` replaces it"
        try:
            end = read_sealed_end(self._log)
        except InvalidSealedEnd as error:
            self._add("crc", f"{error}; {repair}", names.SEALED_END)
            return
        if end is not None and self._log_id not in (None, end.log_id):
            text = f"belongs to log {end.log_id}, not {self._log_id}: {repair}"
            self._add("log_id", visible(text), names.SEALED_END)

    def _report(self, done: int) -> None:
        total = max(self._bytes // 1_000_000, 1)
        report_progress("verifying", min(done // 1_000_000, total), total, "MB")

    def _skip_segment(self, segment: names.SegmentPath, reach: Offset | None) -> None:
        """Report the offsets of a segment that does not belong here as missing."""
        if reach is not None:
            text = "the segment for these events is missing"
            self._add("gap", text, segment.path.name, segment.base, Offset(reach - 1))
            self._next_offset = reach
        self._expected_hashes = set()

    def _check_head(self, segment: names.SegmentPath) -> dict[str, str] | None:
        """The head of a segment; None for one of another log or base, empty for a damaged one."""
        try:
            head = names.head_of(segment.path, segment.base)
        except names.WrongPlace as error:
            self._add("chain", str(error), segment.path.name)
            return None
        except (LogDamaged, NotALog) as error:
            self._add("crc", str(error), segment.path.name)
            return {}
        self._log_id = self._log_id or head["log_id"]
        if head["log_id"] != self._log_id:
            text = f"belongs to log {head['log_id']}, not {self._log_id}"
            self._add("log_id", text, segment.path.name)
            return None
        return head

    def _check_file(self, segment: names.SegmentPath, scan: Scan, head: dict[str, str]) -> None:
        name = segment.path.name
        check = check_sealed(segment.path)
        if check.fault is not None:
            known = "" if scan.gaps else "; no event is affected"
            self._add("crc", f"{check.fault}{known}", name)
        elif scan.index_fault is not None:
            self._add("crc", scan.index_fault, name)
        previous = head.get(names.PREVIOUS, NO_PREVIOUS)
        if head and self._expected_hashes and previous not in self._expected_hashes:
            self._add("chain", "was not written after the segment before it", name)
        self._expected_hashes = {check.sha256, head.get(REPLACES, check.sha256)}

    def _check_end(self, name: str, scan: Scan) -> None:
        if scan.lost_bytes and not scan.gaps and not self._has_writer:
            text = f"{counted(scan.lost_bytes, 'byte')} at its end: the writer died while writing"
            self._add("torn", text, name, count=scan.torn_events)

    def _verify_events(self, segment: names.SegmentPath, scan: Scan) -> None:
        fd = os.open(segment.path, os.O_RDONLY)
        try:
            for chunk in scan.chunks:
                self._report(self._bytes_done + chunk.position)
                for event in scanned_events(fd, scan, chunk):
                    self._events.check(event)
                    self._has_redactions |= event.key in (REDACTED_KEY, REDACTION_KEY)
                    self._count += 1
        finally:
            os.close(fd)

    def _add(
        self,
        kind: Kind,
        message: str,
        segment: str,
        first: Offset | None = None,
        last: Offset | None = None,
        *,
        count: int | None = None,
    ) -> None:
        if count is None:
            count = 1 if first is None or last is None else last - first + 1
        self._found.append(Finding(kind, message, segment, first, last, count))


def _size_of(segment: names.SegmentPath) -> int:
    try:
        return segment.path.stat().st_size
    except OSError:  # sealed meanwhile, or unreadable, which is reported when it is read
        return 0


def _log_id_of(segments: list[names.SegmentPath], end: SealedEnd | None) -> str | None:
    """The log id that recovery would keep; None if no head can be read."""
    carried = []
    for segment in segments:
        try:
            head = names.head_at_any_base(segment.path)
        except (LogDamaged, NotALog):
            continue
        base = Offset(int(head["base"]))
        carried.append(CarriedId(head["log_id"], base, base == segment.base))
    if not carried and end is not None:
        return end.log_id
    return own_log_id(carried, None if end is None else end.log_id)


@dataclass(frozen=True, slots=True)
class ArchiveVerification:
    """The result of `verify_archive`: how much was read, the findings, and the objects that no
    entry of the manifest names: what a killed archiver left."""

    url: str
    log_id: str
    segments: int
    events: int
    size_bytes: int
    findings: tuple[Finding, ...]
    unnamed: tuple[str, ...]


def verify_archive(store: ObjectStore) -> ArchiveVerification:
    """Read every byte of an archive; compare it with the manifest, and the heads of its segments
    with the chain. Needs no log, and reads no event. Raises ArchiveError."""
    archive = Archive(store)
    entries = archive.read_entries()
    found: list[Finding] = []
    there = store.sizes(SEGMENTS)
    for number, (each, fault) in enumerate(zip(entries, chain_faults(entries), strict=True)):
        report_progress("verifying", number, len(entries), "segments")
        wrong = [fault] if fault is not None else []
        wrong += _archived_faults(archive, each)
        found += [_archive_finding(kind, text, each) for kind, text in wrong]
    report_progress("verifying", max(len(entries), 1), max(len(entries), 1), "segments")
    return ArchiveVerification(
        store.url,
        archive.log_id,
        len(entries),
        max((each.following for each in entries), default=0),
        sum(each.size for each in entries),
        tuple(found),
        tuple(sorted(there.keys() - {each.object for each in entries})),
    )


def _archived_faults(archive: Archive, entry: ManifestEntry) -> Iterator[tuple[Kind, str]]:
    """What is wrong with an archived segment."""
    try:
        archive.check(entry)
        head = archive.head_of(entry)
        with TemporaryDirectory(prefix="mapfold-") as folder:
            stand_in_for(archive, entry, Path(folder) / "segment")
    except NoSuchObject as error:
        yield "gap", str(error)
    except (ArchiveError, LogDamaged, NotALog) as error:
        yield "crc", str(error)
    else:
        said = (entry.log_id, entry.previous_sha256, entry.replaces_sha256)
        if said != (head["log_id"], head.get(names.PREVIOUS), head.get(REPLACES, "")):
            yield "chain", f"the manifest contradicts the segment's head ({entry.name})"


def _archive_finding(kind: Kind, message: str, entry: ManifestEntry) -> Finding:
    first, last = Offset(entry.base), Offset(entry.following - 1)
    return Finding(kind, message, entry.object, first, last, last - first + 1)
