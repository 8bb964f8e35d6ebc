"""Seals finished segments beside the recording, one after the other, in a thread of its own.

Compressing and hashing release the interpreter lock, so recording goes on; for a recorder the
thread has a process do the work (`_aside`), and does it itself when there is none to be had.
Recording goes first: while it is in a hurry sealing waits, until so many segments wait that it is
their turn, and it may fall behind anyway. That costs disk (a segment waits at its full size), and
no more. What fails here costs nothing either: the active file stays, is read as before, and is
tried again, on the next start at the latest. Nor does it cost anything to be stopped in the middle,
so the thread keeps no process alive that forgot to close.
"""

import queue
import shutil
import threading
from collections import deque
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.errors import LogDamaged, LogError, MapfoldError

from ._active_file import ActiveFile
from ._aside import ProcessGone, SealingProcess
from ._naming import ACTIVE, SEALED, segment_path
from ._seal import SegmentPlan, seal
from .fsync import sync_directory

_MOST_WAITING: Final = 256
"""Segments that wait at most for the sake of a recording in a hurry, 16 GiB …"""
_FREE_DISK_SHARE: Final = 4
"""… and never more than this part of the disk that is free."""
_LOOK_AGAIN_S: Final = 0.25


class Finished(NamedTuple):
    """A segment that was written to its end: its offsets are ``base`` to before ``following``."""

    base: int
    following: int


class Sealer:
    """``submit`` segments in offset order; ``finish`` waits for all of them."""

    def __init__(
        self, log: Path, log_id: str, previous_sha256: str, *, aside: bool = False
    ) -> None:
        self._log = log
        self._aside = aside
        self._process: SealingProcess | None = None
        self._log_id = log_id
        self._previous_sha256 = self._sealed_sha256 = previous_sha256
        self._submitted: queue.Queue[Finished | None] = queue.Queue()
        self._finishing = False
        self._at_leisure = threading.Event()
        self._at_leisure.set()
        self._damaged = False
        self._thread: threading.Thread | None = None
        self._count = self._sealed = 0
        self.error: LogError | None = None
        """Why the segment at hand is not sealed; None again once it is."""

    @property
    def waiting(self) -> int:
        """Segments submitted and not sealed."""
        return self._count - self._sealed

    def submit(self, base: int, following: int, *, last: bool = False) -> None:
        """Seal the finished active segment of offsets ``base`` to before ``following`` when its
        turn comes."""
        self._finishing = last  # too late for a process that is not there yet
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mapfold-sealer", daemon=True)
            self._thread.start()
        self._count += 1
        self._submitted.put(Finished(base, following))

    def hurry(self, on: bool) -> None:
        """Put sealing off, or no longer."""
        if on:
            self._at_leisure.clear()
        else:
            self._at_leisure.set()

    def finish(self) -> None:
        """Wait until everything submitted is sealed or has failed; `error` says which."""
        self._at_leisure.set()
        if self._thread is not None:
            self._submitted.put(None)
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        waiting: deque[Finished] = deque()
        while (finished := self._submitted.get()) is not None:
            waiting.append(finished)
            self._work_off(waiting)
        self._work_off(waiting)
        if self._process is not None:
            self._process.close()

    def _work_off(self, waiting: deque[Finished]) -> None:
        """Seal in order, for a segment carries the hash of the one before it. A disk that refused
        is tried again when the next segment comes; damage stays."""
        while waiting and not self._damaged:
            path = segment_path(self._log, waiting[0].base, ACTIVE)
            self._wait_for_leisure(path)
            try:
                self._seal(waiting[0])
            except OSError as error:
                self.error = LogError(
                    f"{path} could not be sealed: {error.strerror or error}; its events are safe "
                    "and readable. It is tried again with the next segment and on the next start"
                )
                return
            except MapfoldError as error:
                self._damaged = True
                self.error = LogError(f"{error}; run `mapfold log recover {self._log}`")
            else:
                self.error = None
                self._sealed += 1
                waiting.popleft()

    def _wait_for_leisure(self, next_one: Path) -> None:
        while self.waiting < _MOST_WAITING and not self._at_leisure.wait(_LOOK_AGAIN_S):
            try:
                size, free = next_one.stat().st_size, shutil.disk_usage(self._log).free
            except OSError:  # sealing will say it
                return
            if size * self.waiting * _FREE_DISK_SHARE > free:
                return

    def _seal(self, segment: Finished) -> None:
        base, following = segment
        active = segment_path(self._log, base, ACTIVE)
        if active.exists():  # else only the folder's sync failed, the time before
            plan = SegmentPlan(self._log, self._log_id, base, self._previous_sha256, following)
            self._sealed_sha256 = self._seal_aside(plan) or self._seal_here(plan)
            active.unlink()
        elif not segment_path(self._log, base, SEALED).exists():
            lost = f"offsets {base} to {following - 1} are lost"
            raise LogDamaged(f"{active} was deleted before it was sealed: {lost}")
        sync_directory(self._log)
        self._previous_sha256 = self._sealed_sha256

    def _seal_here(self, plan: SegmentPlan) -> str:
        file = ActiveFile(segment_path(self._log, plan.base, ACTIVE), plan.base)
        return seal(plan, (file.read_chunk(chunk) for chunk in file.chunks))

    def _seal_aside(self, plan: SegmentPlan) -> str | None:
        """None when this process must do it."""
        try:
            if self._process is None and self._aside and not self._finishing:
                self._process = SealingProcess()
            return None if self._process is None else self._process.seal(plan)
        except ProcessGone:
            self._aside, self._process = False, None
            return None
