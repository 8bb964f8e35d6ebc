"""A disk that may lose power: which files there can be afterwards.

What a program does to the files of one folder is noted, call by call, while it really happens.
From the notes up to any call follow the folders that a power cut there may leave:

* What a file held at its last fdatasync or fsync is there. Of each write after that nothing may be
  there, or all, or its first half; what is missing before something that is there reads as zeros.
* A name that was made, exchanged or deleted since the folder's last fsync may or may not have been,
  each by itself, a rename as one; what stood before is then still there.
* A folder is there when the folder it stands in was synced after it was made.

This is more than journalling file systems do to their users, and what POSIX allows.
"""

import itertools
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

_CLOSELY = 3
"""So many writes since a sync are looked at one by one: a chunk's head, its body, its mark."""


@dataclass(eq=False)
class _File:
    """``synced`` is what must be there, ``writes`` came after: (position, bytes)."""

    synced: bytearray = field(default_factory=bytearray)
    writes: list[tuple[int, bytes]] = field(default_factory=list)
    size: int = 0

    def write(self, data: bytes) -> None:
        self.writes.append((self.size, data))
        self.size += len(data)

    def truncate(self, size: int) -> None:
        whole = self.with_writes([data for _, data in self.writes])[:size]
        self.synced, self.writes, self.size = bytearray(whole), [], size

    def sync(self) -> None:
        self.synced = bytearray(self.with_writes([data for _, data in self.writes]))
        self.writes.clear()

    def with_writes(self, kept: list[bytes]) -> bytes:
        content = bytearray(self.synced)
        for (at, _), data in zip(self.writes, kept, strict=True):
            if data:
                content.extend(bytes(max(0, at + len(data) - len(content))))
                content[at : at + len(data)] = data
        return bytes(content)

    def outcomes(self) -> set[bytes]:
        """What may be in it after a power cut. Of all but the last writes: all or nothing."""
        old = [data for _, data in self.writes[:-_CLOSELY]]
        recent = [(b"", data[: len(data) // 2], data) for _, data in self.writes[-_CLOSELY:]]
        return {
            self.with_writes([*before, *kept])
            for before in (old, [b""] * len(old))
            for kept in itertools.product(*recent)
        }


_NameChange = tuple[str | None, str | None, _File | None]
"""The name that goes, the name that comes, and what it then stands for."""


class _Folder:
    """The names in one folder: as of its last sync, and what was done to them since."""

    def __init__(self) -> None:
        self.there = False
        self.synced: dict[str, _File] = {}
        self.changes: list[_NameChange] = []

    def now(self) -> dict[str, _File]:
        return self.after(self.changes)

    def after(self, changes: list[_NameChange]) -> dict[str, _File]:
        names = dict(self.synced)
        for gone, come, file in changes:
            if gone is not None:
                names.pop(gone, None)
            if come is not None and file is not None:
                names[come] = file
        return names

    def sync(self) -> None:
        self.synced = self.now()
        self.changes.clear()

    def outcomes(self) -> Iterator[dict[str, _File]]:
        """The names that there may be after a power cut, with the files they stand for."""
        for kept in itertools.product((True, False), repeat=len(self.changes)):
            yield self.after(list(itertools.compress(self.changes, kept)))


@dataclass(frozen=True)
class Call:
    """One call, and what it does to the model; ``promised`` is what had been said by then."""

    name: str
    do: Callable[[_Folder], None]
    promised: int


_FILE_CALLS = ("open", "close", "write", "ftruncate", "fdatasync", "fsync")
_NAME_CALLS = ("replace", "unlink", "link", "mkdir")
_NOT_MODELLED = ("rename", "truncate", "rmdir", "symlink")


class Tracer:
    """Notes what is done in ``folder``, from any thread. ``promise`` is kept by the program."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.calls: list[Call] = []
        self.promise = 0
        self._files: dict[int, _File | None] = {}
        self._names: dict[str, _File] = {}
        self._lock = threading.RLock()
        for name in _FILE_CALLS + _NAME_CALLS + _NOT_MODELLED:
            monkeypatch.setattr(os, name, self._noted(name, getattr(os, name)))

    def _noted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        note = getattr(self, f"_{name}", None)

        def call(*args: Any, **options: Any) -> Any:
            with self._lock:
                result = real(*args, **options)
                if note is not None:
                    note(result, *args)
                elif self._is_ours(args[0]):
                    raise AssertionError(f"os.{name} is not modelled")
                return result

        return call

    def _is_ours(self, path: Any) -> bool:
        return isinstance(path, str | Path) and Path(path).parent == self.folder

    def end(self) -> list[Call]:
        """Everything noted, and the last promise."""
        return [*self.calls, Call("end", lambda _: None, self.promise)]

    def _add(self, name: str, do: Callable[[_Folder], None]) -> None:
        self.calls.append(Call(name, do, self.promise))

    def _mkdir(self, _: None, path: Any, *__: Any) -> None:
        if Path(path) == self.folder:
            self._add("mkdir", lambda folder: None)

    def _open(self, fd: int, path: Any, flags: int, *_: Any) -> None:
        if not isinstance(path, str | Path):
            return
        if Path(path) == self.folder:
            self._files[fd] = None
        elif Path(path) == self.folder.parent:
            self._files[fd] = _PARENT
        elif self._is_ours(path):
            name = Path(path).name
            if name not in self._names and flags & os.O_CREAT:
                made = self._names[name] = _File()
                self._add(f"create {name}", lambda f: f.changes.append((None, name, made)))
            file = self._files[fd] = self._names[name]
            if flags & os.O_TRUNC:
                self._add(f"empty {name}", lambda _: file.truncate(0))

    def _close(self, _: None, fd: int) -> None:
        self._files.pop(fd, None)

    def _write(self, count: int, fd: int, data: Any) -> None:
        file = self._files.get(fd)
        if file is not None:
            taken = bytes(data[:count])
            self._add(f"write {count}", lambda _: file.write(taken))

    def _ftruncate(self, _: None, fd: int, size: int) -> None:
        file = self._files.get(fd)
        if file is not None:
            self._add(f"truncate {size}", lambda _: file.truncate(size))

    def _fdatasync(self, _: None, fd: int) -> None:
        if fd not in self._files:
            return
        file = self._files[fd]
        if file is None:
            self._add("sync folder", lambda folder: folder.sync())
        elif file is _PARENT:
            self._add("sync parent", lambda folder: setattr(folder, "there", True))
        else:
            self._add("sync", lambda _: file.sync())

    _fsync = _fdatasync

    def _replace(self, _: None, source: Any, target: Any) -> None:
        if self._is_ours(source):
            gone, come = Path(source).name, Path(target).name
            file = self._names[come] = self._names.pop(gone)
            self._add(f"rename to {come}", lambda f: f.changes.append((gone, come, file)))

    def _unlink(self, _: None, path: Any, *__: Any) -> None:
        if self._is_ours(path):
            name = Path(path).name
            self._names.pop(name)
            self._add(f"unlink {name}", lambda f: f.changes.append((name, None, None)))

    def _link(self, _: None, source: Any, target: Any, **__: Any) -> None:
        if self._is_ours(source):
            come = Path(target).name
            file = self._names[come] = self._names[Path(source).name]
            self._add(f"link {come}", lambda f: f.changes.append((None, come, file)))


_PARENT = _File()


def power_cuts(
    calls: list[Call], worthless: Callable[[str], bool]
) -> Iterator[tuple[str, int, dict[str, bytes] | None]]:
    """After each call: its name, what had been promised by the next, and each content the folder
    may have, once (None: there is no folder). Plays the calls, so they can be played once only."""
    folder = _Folder()
    for call, following in itertools.pairwise(calls):
        call.do(folder)
        if not folder.there:
            yield call.name, following.promised, None
        seen: set[tuple[tuple[str, bytes], ...]] = set()
        for names in folder.outcomes():
            kept = {name: file for name, file in names.items() if not worthless(name)}
            outcomes = [file.outcomes() for file in kept.values()]
            seen.update(
                tuple(zip(kept, contents, strict=True)) for contents in itertools.product(*outcomes)
            )
        for found in sorted(seen):
            yield call.name, following.promised, dict(found)
