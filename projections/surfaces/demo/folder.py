"""The demo's output folder: emptied at the start of each demo, if a demo made it.

A file named ``MARKER`` says that the demo made a folder. Its log, questions and picture are removed
before the next demo; the database server's files in it are kept, because making them takes longest
and a replay replaces what is in them. A running demo holds a lock on ``MARKER``: a second one in
the same folder would remove its log.
"""

import contextlib
import fcntl
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from eventsrc.base.errors import MisuseError

MARKER: Final = ".mapfold-demo"
_GENERATED: Final = ("map.png", "settings.json", "question-*.json", "record.txt", "simulate.txt")


@dataclass(frozen=True, slots=True)
class DemoFolder:
    """Paths of one demo's files."""

    path: Path

    @property
    def log(self) -> Path:
        """The event log."""
        return self.path / "log"

    @property
    def map(self) -> Path:
        """The picture."""
        return self.path / "map.png"

    @property
    def settings(self) -> Path:
        """The fold's settings, for ``--settings``."""
        return self.path / "settings.json"

    def question(self, crops: int) -> Path:
        """The question with this many crops, as the lost robot asked it."""
        return self.path / f"question-{crops}.json"

    def stderr_of(self, child: str) -> Path:
        """The file of a child process' stderr."""
        return self.path / f"{child}.txt"


@contextlib.contextmanager
def fresh_folder(path: Path) -> Iterator[DemoFolder]:
    """An empty demo folder at ``path``, locked until the end.

    Raises MisuseError when something else is there, or another demo is at work in it.
    """
    with contextlib.ExitStack() as held:
        try:
            _lock(path, held)
            folder = DemoFolder(path)
            _remove_old(folder)
        except OSError as error:
            raise MisuseError(f"{path}: {error.strerror}; choose another --out") from None
        yield folder


def _lock(path: Path, held: contextlib.ExitStack) -> None:
    """Mark the folder, and lock the mark for as long as ``held`` is; see `fresh_folder`."""
    if path.exists() and not (path / MARKER).exists() and any(path.iterdir()):
        raise MisuseError(
            f"{path}: not empty and not made by the demo; choose another --out or remove it"
        )
    path.mkdir(parents=True, exist_ok=True)
    mark = held.enter_context((path / MARKER).open("a"))
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise MisuseError(
            f"{path}: another demo is at work there; wait for it or choose another --out"
        ) from None
    mark.truncate(0)
    mark.write("made by mapfold demo; the next one removes it\n")
    mark.flush()


def _remove_old(folder: DemoFolder) -> None:
    if folder.log.exists():
        shutil.rmtree(folder.log)
    for pattern in _GENERATED:
        for old in folder.path.glob(pattern):
            old.unlink()
