"""The cache of histories beside a log: ``<log>.history``.

For each choice of settings and commands in force there are parts, ``KEY-START-END.npz``, of which
each has the history of the events from START to before END, and the folds at the last ENDs,
``KEY-END.fold``, from which it is folded on. ``KEY-START-END.vectors`` has the unit vectors of the
observations of the same events, kept by the first question that compares all of them.
``KEY-END.VERSION.digest`` has the digest of the map after END events, for the ENDs used last. Files
are written under another name and renamed, and never changed, so any number of processes may read
and write: the same log gives the same files.

A part is used only if it is of this log, these settings and commands and this version of the fold,
if the segments that it was made from are as they were, and if the last event that it covers is
still the same: a log that lost its end and was recorded on has other events there. Parts from the
first that does not fit on are not used and are replaced. A failure of the cache is reported as a
note and makes the answer slower, never wrong.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeAlias, TypeVar

from eventsrc.base.errors import LogError
from eventsrc.base.machine import system_clock
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import (
    LogReader,
    cache_folder,
    delete_left_over_files,
    event_hash,
    make_cache_folder,
    same_but_sealed,
    segment_signatures,
    write_cache_file,
)
from projections.fold import FOLD_VERSION, State, part, prefixed
from projections.fold.corrections import Corrections, map_fingerprint
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.digest import VERSION
from projections.map.fold import with_vectors

from .columns import Stripe, joined_short
from .kept_files import FORMAT, MalformedState, PartFile, Unwritable, pack, read_state, write_part
from .tables import DamagedPart

MIN_EVENTS: Final = 2_000
"""Events; folding fewer takes about as long as starting Python."""
MOST_KEPT: Final = 4
"""The most histories of a log that are kept: those used last."""
MOST_BYTES: Final = 1024 * 1024 * 1024
"""While all together take more, those unused for longest are deleted, except the one used last."""
MOST_FOLDS: Final = 3
"""The most folds of a history that are kept: the latest. A tail whose database is behind the last
one goes on from one before it."""
MOST_DIGESTS: Final = 16
"""The most digests of a history that are kept: those made last."""
PartKind: TypeAlias = Literal["npz", "vectors"]
_PART: Final = re.compile(r"([0-9a-f]{16})-(\d{20})-(\d{20})\.(npz|vectors)")
_FOLD: Final = re.compile(r"([0-9a-f]{16})-(\d{20})\.fold")
_DIGEST: Final = re.compile(r"([0-9a-f]{16})-(\d{20})\.\d+\.digest")
_OF_A_HISTORY: Final = re.compile(r"([0-9a-f]{16})-[0-9.-]+\.(npz|vectors|fold|digest)(\.away)?")
_NO_FILE: Final = frozenset({errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV})
"""Errors of opening something other than a regular file."""
_TRIES: Final = 3
"""The most attempts to read a folder in which other processes replace files."""

MISFITS: Final = (LookupError, TypeError, AttributeError, ValueError, OverflowError)
"""Errors of a content that does not fit together."""

_T = TypeVar("_T")
Note = Callable[[str], None]


class _File(NamedTuple):
    start: Offset
    end: Offset
    path: Path


class TimelineCache:
    """The cached history of a log under some settings and commands; ``note`` is called with a
    message for each part that cannot be used or kept."""

    def __init__(
        self, reader: LogReader, settings: Settings, corrections: Corrections, note: Note
    ) -> None:
        self.folder = cache_folder(reader.path)
        self._reader = reader
        self._settings, self._corrections = settings, corrections
        self._note = note
        self._key = _key(reader.log_id, settings, corrections)
        self._noted: set[str] = set()
        self._kept_at: Offset | None = None  # by this process

    def stripes(self, end: Offset, kind: PartKind = "npz") -> list[Stripe]:
        """The cached stripes of at most the first ``end`` events."""
        for _ in range(_TRIES):
            with contextlib.suppress(FileNotFoundError):  # another process replaced parts
                return self._chain(end, kind)
        return []

    def _chain(self, end: Offset, kind: PartKind) -> list[Stripe]:
        found: list[Stripe] = []
        files = self._files(kind)
        at = FIRST_OFFSET
        while after := [file for file in files if file.start == at and at < file.end <= end]:
            for file in sorted(after, key=lambda file: -file.end):
                if (opened := self._open(file)) is not None:
                    found += opened.stripes
                    at = file.end
                    break
            else:
                break
        if found:
            self._touch(files)
        return found

    def fold_before(self, limit: Offset) -> SemanticMap | None:
        """The latest cached fold of at most ``limit`` events; None if there is none."""
        found = (self.fold_at(end) for end in reversed(self._fold_ends()) if end <= limit)
        return next((fold for fold in found if fold is not None), None)

    def _fold_ends(self) -> list[Offset]:
        stems = (path.stem for path in self._paths() if self._is_own(_FOLD, path))
        return sorted(Offset(int(stem.partition("-")[2])) for stem in stems)

    def fold_at(self, end: Offset) -> SemanticMap | None:
        """The fold after ``end`` events; None if it is not cached."""

        def load(state: State) -> SemanticMap:
            semantic_map = SemanticMap(self._settings, self._corrections)
            semantic_map.load(part("map", state))
            semantic_map.use_names(semantic_map.next_offset, self._corrections)
            return semantic_map

        loaded = self._loaded(self._fold_path(end), end, load)
        return None if loaded is None else with_vectors(loaded, self._reader)

    def names_before(self, limit: Offset) -> list[str]:
        """The files' names of the latest cached fold of at most ``limit`` events."""
        end = max((each for each in self._fold_ends() if each <= limit), default=FIRST_OFFSET)
        parts = self._parts_to(end, "npz")
        paths = [file.path for file in parts] + [self._fold_path(end), self._digest_path(end)]
        return [each.name for each in paths if parts and not parts[-1].start and each.exists()]

    def digest_at(self, end: Offset) -> str | None:
        """The digest of the map after ``end`` events; None if it is not cached."""
        if end < MIN_EVENTS:
            return None
        return self._loaded(self._digest_path(end), end, lambda state: str(state["digest"]))

    def keep_digest(self, end: Offset, digest: str) -> None:
        """Store the digest of the map after ``end`` events, and delete all but the latest ones."""
        if end < MIN_EVENTS or not self.folder.is_dir():
            return
        try:
            self._write_state(self._digest_path(end), end, {"digest": digest})
            found = [path for path in self._paths() if self._is_own(_DIGEST, path)]
            for path in sorted(found, key=_age_s)[MOST_DIGESTS:]:
                path.unlink(missing_ok=True)
        except (OSError, LogError) as error:
            self._say(f"{self.folder}: no digest was kept: {getattr(error, 'strerror', error)}")

    def _loaded(self, path: Path, end: Offset, load: Callable[[State], _T]) -> _T | None:
        """``load`` applied to a file about the first ``end`` events; None if there is none or it is
        unusable."""
        try:
            state = read_state(path)
            self._check(part("about", state), FIRST_OFFSET, end)
            return load(state)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, LogError, DamagedPart, MalformedState, zlib.error) as error:
            self._say(f"{path} is not used: {error}")
        except MISFITS as error:
            self._say(f"{path} is not used: its content does not fit together: {error!r}")
        return None

    def is_worth(self, folded: int) -> bool:
        """Whether to cache a history with ``folded`` more events than the cache has: first from
        `MIN_EVENTS` on, later in the same process when it has grown by a tenth."""
        grown = 0 if self._kept_at is None else self._kept_at // 10
        return folded >= max(MIN_EVENTS, grown)

    def keep(self, stripes: Sequence[Stripe], semantic_map: SemanticMap) -> None:
        """Cache the history of all events that ``semantic_map`` has folded."""
        self._kept_at = end = semantic_map.next_offset
        with self._writing("npz"):
            make_cache_folder(self._reader.path)
            self._write_state(self._fold_path(end), end, prefixed("map", semantic_map.dump()))
            self._keep_part(stripes, "npz")
            self._tidy(end)

    def keep_vectors(self, stripes: Sequence[Stripe], kept: Offset) -> None:
        """Cache the vectors of the first events, of which ``kept`` are cached, if many are not."""
        end = stripes[-1].end if stripes else FIRST_OFFSET
        if end - kept >= MIN_EVENTS:
            with self._writing("vectors"):
                self._keep_part(stripes, "vectors")
                self._tidy_parts(end, "vectors")
                self._limit()

    @contextlib.contextmanager
    def _writing(self, kind: PartKind) -> Iterator[None]:
        try:
            yield
        except (OSError, Unwritable, LogError) as error:
            why = f"no history was kept: {getattr(error, 'strerror', error)}"
            self._say(f"{self.folder}: {why}; --no-cache goes without one")
        except DamagedPart as damage:
            self.forget(damage, kind)

    def forget(self, damage: DamagedPart, kind: PartKind = "npz") -> None:
        """Delete all parts of this kind, after one was found damaged."""
        done = "history is folded" if kind == "npz" else "vectors are read from the log"
        self._say(f"{damage}; the {done} again")
        for file in self._files(kind):
            with contextlib.suppress(OSError):
                file.path.unlink(missing_ok=True)
        if kind == "npz":
            self._kept_at = None

    def _keep_part(self, stripes: Sequence[Stripe], kind: PartKind) -> None:
        """Write the stripes that no part has yet, merged with earlier parts that are not longer."""
        end = stripes[-1].end
        start = FIRST_OFFSET
        while longer := [
            file
            for file in self._files(kind)
            if file.start == start and start < file.end < end and file.end - start > end - file.end
        ]:
            start = max(file.end for file in longer)
        new = [stripe for stripe in stripes if stripe.start >= start]
        if not new or new[0].start != start:  # a stripe is in two parts: it was joined in memory
            start, new = FIRST_OFFSET, list(stripes)
        if kind == "npz":
            new = joined_short(new)
        write_cache_file(
            self.folder / f"{self._key}-{start:020d}-{end:020d}.{kind}",
            lambda file: write_part(file, self._about(start, end), new),
        )

    def _write_state(self, path: Path, end: Offset, state: State) -> None:
        data = pack(prefixed("about", self._about(FIRST_OFFSET, end)) | state)
        write_cache_file(path, lambda file: file.write(data))

    def _about(self, start: Offset, end: Offset) -> dict[str, Any]:
        return {
            "key": self._key,
            "start": start,
            "end": end,
            "segments": list(segment_signatures(self._reader.path, end)),
            "last_event": self._event_hash(end),
        }

    def _open(self, file: _File) -> PartFile | None:
        try:
            opened = PartFile(file.path)
            self._check(opened.about, *opened.span)
            self._check(opened.about, file.start, file.end)
        except FileNotFoundError:
            raise
        except LogError as error:  # the events asked for may be before the damage
            self._say(f"{file.path} is not used: {error}")
            return None
        except OSError as error:
            self._say(f"{file.path} is not used: {error.strerror}")
            if error.errno not in _NO_FILE:  # too many open files, or not ours to read
                return None
        except DamagedPart as error:
            self._say(f"{file.path} is not used: {error}")
        except (LookupError, TypeError, AttributeError, ValueError) as error:
            self._say(f"{file.path} is not used: its content does not fit together: {error!r}")
        else:
            return opened
        with contextlib.suppress(OSError):
            file.path.unlink(missing_ok=True)
        return None

    def _check(self, about: dict[str, Any], start: Offset, end: Offset) -> None:
        """Raise DamagedPart unless ``about`` names these events of this log."""
        if (about["key"], about["start"], about["end"]) != (self._key, start, end):
            raise DamagedPart("it is of another log or other events, settings or commands")
        signatures = segment_signatures(self._reader.path, end)
        is_same = same_but_sealed(about["segments"], signatures)
        if not is_same or len({about["last_event"], self._event_hash(end)} - {None}) > 1:
            raise DamagedPart("the log has lost events since it was made")

    def _event_hash(self, end: Offset) -> str | None:
        """The hash of the last event below ``end``; None in a segment away, which never changes."""
        if [each for each in self._reader.segments if each.base < end][-1].away:
            return None
        (event,) = self._reader.read(Offset(end - 1), end)
        return event_hash(event)

    def _files(self, kind: PartKind) -> list[_File]:
        """The parts of this history."""
        found = [(path, _PART.fullmatch(path.name)) for path in self._paths()]
        return [
            _File(Offset(int(name[2])), Offset(int(name[3])), path)
            for path, name in found
            if name is not None and (name[1], name[4]) == (self._key, kind)
        ]

    def _paths(self) -> list[Path]:
        try:
            return sorted(self.folder.iterdir())
        except OSError:  # none yet, or not ours to read
            return []

    def _fold_path(self, end: Offset) -> Path:
        return self.folder / f"{self._key}-{end:020d}.fold"

    def _digest_path(self, end: Offset) -> Path:
        return self.folder / f"{self._key}-{end:020d}.{VERSION}.digest"

    def _is_own(self, pattern: re.Pattern[str], path: Path) -> bool:
        """Whether the name of a file matches the pattern and is of this history."""
        found = pattern.fullmatch(path.name)
        return found is not None and found[1] == self._key

    def _touch(self, files: Sequence[_File]) -> None:
        """Mark this history as the one used last."""
        for file in files:
            with contextlib.suppress(OSError):
                os.utime(file.path)

    def _tidy(self, end: Offset) -> None:
        """Delete files that the history of ``end`` events replaces, the histories unused for
        longest, and temporary files of killed processes."""
        self._tidy_parts(end, "npz")
        for older in [each for each in self._fold_ends() if each <= end][:-MOST_FOLDS]:
            self._fold_path(older).unlink(missing_ok=True)
        delete_left_over_files(self.folder)
        self._limit()

    def _tidy_parts(self, end: Offset, kind: PartKind) -> None:
        """Delete the parts that those of the first ``end`` events replace."""
        for file in set(self._files(kind)) - set(self._parts_to(end, kind)):
            if file.end <= end:
                file.path.unlink(missing_ok=True)

    def _parts_to(self, end: Offset, kind: PartKind) -> list[_File]:
        """The parts that lead to ``end`` events, the last one first."""
        files, found, at = self._files(kind), list[_File](), end
        while at > FIRST_OFFSET and (before := [file for file in files if file.end == at]):
            found.append(min(before, key=lambda file: file.start))
            at = found[-1].start
        return found

    def _limit(self) -> None:
        """Delete histories beyond `MOST_KEPT` and `MOST_BYTES`, those unused for longest first."""
        sizes: dict[str, int] = {}
        used: dict[str, float] = {}
        by_key: dict[str, list[Path]] = {}
        for path in self._paths():
            if (found := _OF_A_HISTORY.fullmatch(path.name)) is not None:
                with contextlib.suppress(FileNotFoundError):
                    key, status = found[1], path.stat()
                    sizes[key] = sizes.get(key, 0) + status.st_size
                    used[key] = max(used.get(key, 0.0), status.st_mtime)
                    by_key.setdefault(key, []).append(path)
        oldest = sorted((key for key in used if key != self._key), key=used.__getitem__)
        while oldest and (len(by_key) > MOST_KEPT or sum(sizes.values()) > MOST_BYTES):
            key = oldest.pop(0)
            del sizes[key]
            for path in by_key.pop(key):
                path.unlink(missing_ok=True)

    def _say(self, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self._note(text)


def _key(log_id: str, settings: Settings, corrections: Corrections) -> str:
    """16 hex digits that identify log, settings and corrections."""
    made = {
        "format": FORMAT,
        "fold_version": FOLD_VERSION,
        "log_id": log_id,
        "settings": settings.fingerprint(),
        "map": map_fingerprint(settings, corrections),
        "commands": [recorded.offset for recorded in corrections.in_force],
    }
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()[:16]


def _age_s(path: Path) -> float:
    with contextlib.suppress(OSError):
        return system_clock() / 1e9 - path.stat().st_mtime
    return 0.0
