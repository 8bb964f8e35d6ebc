"""An archive of a log in a store of objects: made, verified and restored.

    archive.json                  format and log id; put first, never changed
    segments/BASE-SHA16.mcap      a sealed segment, byte for byte, named by its SHA-256 too
    manifest/BASE.json            a `ManifestEntry`: its offsets, size, SHA-256 and chain
    kept/NAME                     files of the kept history (`log_identity.cache_folder`)

An object is put only if it is not there, read back and compared, and only then named by an entry of
the manifest: what no entry names does not count. So an archiver may be killed at any moment, run
again, or run twice at once. Two archivers of one log put the same bytes.

An entry is replaced in one case: its segment was redacted here, which an event says.
A segment that was *recovered* here is not put in the place of the original, which has more events.
"""

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from eventsrc.base.errors import ArchiveError, LogDamaged, LogError, NoSuchObject
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from .archive_place import note_archive_place, place_locked, refuse_away
from .durable_files import write_all
from .lock import is_held
from .reader import LogReader
from .redact import read_redactions
from .seal import NO_PREVIOUS, REPLACES, file_sha256
from .sealed_end import segments_of
from .sealed_segment import SealedFile, check_sealed
from .segment import Unreadable
from .verify_events import Kind
from .writer import LogWriter

FORMAT: Final = 1
IDENTITY: Final = "archive.json"
MANIFEST: Final = "manifest/"
KEPT: Final = "kept/"
SEGMENTS: Final = "segments/"
READERS: Final = 16  # threads: each waits for the network


class NothingSealed(LogError):
    """A log has no sealed segment yet."""


_Natural = Annotated[int, msgspec.Meta(ge=0)]
_Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class ManifestEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """What an archive says of one segment: offsets ``base`` to before ``following``.

    ``index_at`` is the byte at which its seal begins, behind the chunks. ``previous_sha256`` is
    what its head names for the segment before, empty for none; ``replaces_sha256`` the original of
    a recovered or redacted segment, which its successor still names.
    """

    log_id: str
    base: _Natural
    following: _Natural
    object: str
    size: _Natural
    index_at: _Natural
    sha256: _Sha256
    previous_sha256: str
    format: int
    replaces_sha256: str = ""

    @property
    def name(self) -> str:
        """The name of this entry's object."""
        return f"{MANIFEST}{self.base:020d}.json"

    @property
    def successor_names(self) -> frozenset[str]:
        """What the segment behind this one may name as the one before it."""
        return frozenset({self.sha256, self.replaces_sha256 or self.sha256})

    def encoded(self) -> bytes:
        """As JSON; the same bytes for the same segment."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"


def _object_name(base: int, sha256: str) -> str:
    return f"{SEGMENTS}{base:020d}-{sha256[:16]}{names.SEALED}"


def _segment_entry(path: Path, base: Offset, sha256: str) -> ManifestEntry:
    segment = SealedFile(path, base)
    try:
        return ManifestEntry(
            log_id=segment.log_id,
            base=base,
            following=segment.next_offset,
            object=_object_name(base, sha256),
            size=segment.size(),
            index_at=segment.index_at,
            sha256=sha256,
            previous_sha256=segment.head.get(names.PREVIOUS, NO_PREVIOUS),
            format=FORMAT,
            replaces_sha256=segment.head.get(REPLACES, ""),
        )
    finally:
        segment.close()


class Archive:
    """The archive in ``store``. Raises ArchiveError for one that is there and is none."""

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        try:
            identity: Any = msgspec.json.decode(store.read(IDENTITY))
            self.log_id = str(identity["log_id"])
            known = identity["format"] == FORMAT
        except NoSuchObject:
            raise NoSuchObject(
                f"{store.url}: there is no archive of a log; check the URL"
            ) from None
        except (msgspec.MsgspecError, KeyError, TypeError):
            known = False
        if not known:
            raise ArchiveError(f"{store.url}/{IDENTITY} is not of this version of mapfold")

    def entries(self, known: Sequence[ManifestEntry] = ()) -> list[ManifestEntry]:
        """The manifest in offset order; ``known`` entries are not read again. Raises ArchiveError
        where it has a gap or its chain is broken."""
        found = self.read_entries(known)
        for each, fault in zip(found, chain_faults(found), strict=True):
            if fault is not None:
                raise ArchiveError(
                    f"{self.store.url}/{each.name}: {fault[1]}; run"
                    f" `{advised('log', 'archive', 'LOG', self.store.url, '--verify')}`"
                )
        return found

    def read_entries(self, known: Sequence[ManifestEntry] = ()) -> list[ManifestEntry]:
        """`entries`, without comparing them to each other."""
        by_name = {each.name: each for each in known}
        listed = list(self.store.sizes(MANIFEST))
        with ThreadPoolExecutor(READERS) as pool:
            return list(pool.map(lambda name: by_name.get(name) or self._entry(name), listed))

    def _entry(self, name: str) -> ManifestEntry:
        place = f"{self.store.url}/{name}"
        try:
            entry = msgspec.json.decode(self.store.read(name), type=ManifestEntry)
        except msgspec.MsgspecError as error:
            raise ArchiveError(f"{place} is no entry of a manifest: {error}") from None
        if (entry.format, entry.name) != (FORMAT, name) or entry.following <= entry.base:
            raise ArchiveError(f"{place} is not of this version of mapfold, or of another segment")
        if entry.object != _object_name(entry.base, entry.sha256):
            raise ArchiveError(f"{place} names an object of another segment")
        if entry.log_id != self.log_id:
            raise ArchiveError(
                f"{place} is of log {entry.log_id}, but the archive of log {self.log_id}"
            )
        return entry

    def entry_at(self, base: int) -> ManifestEntry:
        """The entry of the segment at ``base``."""
        return self._entry(f"{MANIFEST}{base:020d}.json")

    def kept_files(self) -> dict[str, int]:
        """Names and sizes of the archived files of the kept history."""
        sizes = self.store.sizes(KEPT)
        return {name.removeprefix(KEPT): size for name, size in sizes.items()}

    def write_checked(self, entry: ManifestEntry, fd: int) -> None:
        """Write the archived segment to a file. Raises ArchiveError unless it has the size and hash
        that the manifest says."""
        size, digest = 0, hashlib.sha256()
        for block in self.store.blocks(entry.object):
            size += len(block)
            digest.update(block)
            if size > entry.size:
                break
            write_all(fd, block)
        self._compare(entry, size, digest.hexdigest())

    def check(self, entry: ManifestEntry) -> None:
        """Read an archived segment back. Raises ArchiveError as `write_checked`."""
        self._compare(entry, *self.store.sha256(entry.object))

    def head_of(self, entry: ManifestEntry) -> dict[str, str]:
        """The head of an archived segment. Raises as `format.read_head`, and ArchiveError."""
        data = self.store.part(entry.object, 0, min(names.HEAD_BYTES, entry.size))
        return names.read_head(Path(entry.object), data, Offset(entry.base))[0]

    def _compare(self, entry: ManifestEntry, size: int, sha256: str) -> None:
        if (size, sha256) != (entry.size, entry.sha256):
            raise ArchiveError(
                f"{self.store.url}/{entry.object}: the store gives {size:,} bytes with the SHA-256"
                f" {sha256[:16]}…, where {entry.size:,} with {entry.sha256[:16]}… should be"
            )


def chain_faults(entries: Sequence[ManifestEntry]) -> Iterator[tuple[Kind, str] | None]:
    """For each entry, what is wrong between it and the one before."""
    at, expected = 0, frozenset({NO_PREVIOUS})
    for each in entries:
        if each.base != at:
            yield "gap", f"offsets {at} to {each.base - 1} before it are not archived"
        elif each.previous_sha256 not in expected:
            yield "chain", "was not written after the segment before it"
        else:
            yield None
        at, expected = each.following, each.successor_names


@dataclass(frozen=True, slots=True)
class Archived:
    """What `archive_log` did: how many segments and bytes were ``added``, how many events the
    archive has, and how many of the log it lacks as they are in no sealed segment."""

    log_id: str
    added_segments: int
    added_bytes: int
    replaced_segments: int
    segments: int
    events: int
    not_sealed: bool


def archive_log(log: Path, store: ObjectStore, *, note: Callable[[str], None]) -> Archived:
    """Put what the archive lacks of the sealed segments of a log. Raises ArchiveError, and LogError
    for a log that cannot be read or is damaged; what was put before stays.

    An unfinished last segment is sealed first if no recorder has the log.
    """
    try:
        _seal_rest(log, note)
        return _archive_sealed(log, store)
    except OSError as error:
        place, reason = error.filename or log, error.strerror or error
        raise LogError(f"{place}: {reason}; check its rights and its disk") from error


def _archive_sealed(log: Path, store: ObjectStore) -> Archived:
    segments = names.list_growing(log)
    refuse_away(log, segments[-1:])
    sealed = [each for each in segments if each.sealed]
    if not sealed:
        raise NothingSealed(f"{log} has no sealed segment yet: there is nothing to archive")
    log_id = names.head_of(sealed[0].path, sealed[0].base)["log_id"]
    identity = msgspec.json.format(msgspec.json.encode({"format": FORMAT, "log_id": log_id}))
    store.put_new(IDENTITY, identity + b"\n")
    archive = Archive(store)
    if archive.log_id != log_id:
        raise ArchiveError(
            f"{store.url} is the archive of log {archive.log_id}, but {log} is log {log_id};"
            " choose another URL"
        )
    return _Archiver(log, archive).run(sealed, not_sealed=len(sealed) < len(segments))


def _seal_rest(log: Path, note: Callable[[str], None]) -> None:
    """Seal what a killed recorder left, as the next recorder would."""
    if all(each.sealed for each in segments_of(log)) or is_held(log):
        return
    try:
        LogWriter(log).close()
    except LogError as error:
        note(f"{error}; what is not sealed is not archived")


class _Archiver:
    def __init__(self, log: Path, archive: Archive) -> None:
        self._log, self._archive, self._store = log, archive, archive.store
        self._entries = {each.base: each for each in archive.entries()}
        with LogReader(log) as reader:
            self._unread: list[Unreadable] = []
            self._redacted = {e.base for _, e in read_redactions(reader, self._unread.append)}
        self._at: int = FIRST_OFFSET
        self._expected = frozenset({NO_PREVIOUS})
        self._added = self._bytes = self._replaced = 0

    def run(self, sealed: Sequence[names.SegmentPath], *, not_sealed: bool) -> Archived:
        total = len(sealed)
        for number, segment in enumerate(sealed):
            report_progress("archiving", number, total, "segments")
            if segment.away:
                continue
            self._skip_to(segment.base)
            entry = self._archived(segment, is_last=number + 1 == total)
            self._at, self._expected = entry.following, entry.successor_names
        report_progress("archiving", total, total, "segments")
        if self._redacted:
            self._delete_redacted()
        if self._unread:
            raise LogDamaged(
                f"{self._log}: redactions cannot be read: {self._unread[0].reason}; what they"
                f" erased may be in {self._store.url} still"
            )
        if os.access(self._log, os.W_OK):
            with place_locked(self._log):
                note_archive_place(self._log, self._store.url)
        events = max((each.following for each in self._entries.values()), default=0)
        done = self._added, self._bytes, self._replaced
        return Archived(self._archive.log_id, *done, len(self._entries), events, not_sealed)

    def _skip_to(self, base: Offset) -> None:
        """Pass segments that only the archive has."""
        while self._at < base:
            entry = self._entries.get(self._at)
            if entry is None:
                raise LogDamaged(
                    f"{self._log}: offsets {self._at} to {base - 1} are neither here nor in"
                    f" {self._store.url}; run `{advised('log', 'verify', self._log)}`"
                )
            self._at, self._expected = entry.following, entry.successor_names

    def _archived(self, segment: names.SegmentPath, *, is_last: bool) -> ManifestEntry:
        head = names.head_of(segment.path, segment.base)
        if head["log_id"] != self._archive.log_id or (
            head.get(names.PREVIOUS, NO_PREVIOUS) not in self._expected
        ):
            raise LogDamaged(
                f"{segment.path} was not written after the segment before it; it is not archived;"
                f" run `{advised('log', 'verify', self._log)}`"
            )
        known = self._entries.get(segment.base)
        if known is None:
            return self._add(segment)
        if segment.base in self._redacted and file_sha256(segment.path) != known.sha256:
            return self._replace(segment, known)
        if known.sha256 == head.get(REPLACES):
            return known  # recovered here, whole there
        same_size = segment.path.stat().st_size == known.size
        if same_size and (not is_last or file_sha256(segment.path) == known.sha256):
            return known  # of all but the last, the next segment names the hash
        raise ArchiveError(
            f"{self._store.url}/{known.object} is another segment than {segment.path}: one of them"
            " is damaged, or the log was recorded on from a copy; run"
            f" `{advised('log', 'archive', self._log, self._store.url, '--verify')}`, or choose"
            " another URL"
        )

    def _add(self, segment: names.SegmentPath) -> ManifestEntry:
        entry = self._put(segment)
        if not self._store.put_new(entry.name, entry.encoded()):
            there = self._store.read(entry.name)  # another archiver was first
            if there != entry.encoded():
                raise ArchiveError(
                    f"{self._store.url}/{entry.name} was put by another archiver, for a segment"
                    f" other than {segment.path}; choose another URL"
                )
        self._entries[entry.base] = entry
        self._added += 1
        self._bytes += entry.size
        return entry

    def _put(self, segment: names.SegmentPath) -> ManifestEntry:
        """Put the object of a segment, and read it back."""
        check = check_sealed(segment.path)
        if check.fault is not None:
            raise LogDamaged(
                f"{segment.path}: {check.fault}; it is not archived, nor what follows; run"
                f" `{advised('log', 'recover', self._log)}`"
            )
        entry = _segment_entry(segment.path, segment.base, check.sha256)
        self._store.put_new(entry.object, segment.path)
        self._archive.check(entry)
        return entry

    def _replace(self, segment: names.SegmentPath, known: ManifestEntry) -> ManifestEntry:
        """Put a redacted segment, and delete the archived one and what was folded from it."""
        entry = self._put(segment)
        for name in self._archive.kept_files():
            self._store.delete(KEPT + name)
        self._store.replace(entry.name, entry.encoded())
        self._entries[entry.base] = entry
        self._store.delete(known.object)
        self._replaced += 1
        return entry

    def _delete_redacted(self) -> None:
        """Delete what an archiver that was killed in `_replace` left."""
        named = {each.object for each in self._entries.values()}
        redacted = tuple(f"{SEGMENTS}{base:020d}-" for base in self._redacted)
        for name in self._store.sizes(SEGMENTS).keys() - named:
            if name.startswith(redacted):
                self._store.delete(name)
