"""Seals finished segments beside the recording, one after the other, in a thread of its own.

Compressing and hashing release the interpreter lock, so recording goes on; for a recorder the
thread has a process do the work (`_aside`), and does it itself when there is none to be had.
Sealing may fall behind a recording that is faster; that costs disk (a segment waits at its full
size), and no more. What fails here costs nothing either: the active file stays, is read as before,
and is sealed on the next start. Nor does it cost anything to be stopped in the middle, so the
thread keeps no process alive that forgot to close.
"""

import queue
import threading
from pathlib import Path

from eventsrc.errors import LogError, MapfoldError

from ._active_file import ActiveFile
from ._aside import ProcessGone, SealingProcess
from ._naming import ACTIVE, segment_path
from ._seal import SegmentPlan, seal
from .fsync import sync_directory


class Sealer:
    """``submit`` bases in offset order; ``finish`` waits for all of them."""

    def __init__(
        self, log: Path, log_id: str, previous_sha256: str, *, aside: bool = False
    ) -> None:
        self._log = log
        self._aside = aside
        self._process: SealingProcess | None = None
        self._log_id = log_id
        self._previous_sha256 = previous_sha256
        self._bases: queue.Queue[int | None] = queue.Queue()
        self._finishing = False
        self._thread: threading.Thread | None = None
        self.error: LogError | None = None

    def submit(self, base: int, *, last: bool = False) -> None:
        """Seal the finished active segment at ``base`` when its turn comes."""
        self._finishing = last  # too late for a process that is not there yet
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mapfold-sealer", daemon=True)
            self._thread.start()
        self._bases.put(base)

    def finish(self) -> None:
        """Wait until everything submitted is sealed or has failed; `error` says which."""
        if self._thread is not None:
            self._bases.put(None)
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while (base := self._bases.get()) is not None:
            if self.error is not None:
                continue  # a later segment carries the hash of this one, so order must hold
            try:
                self._seal(base)
            except OSError as error:
                self.error = LogError(
                    f"{segment_path(self._log, base, ACTIVE)} could not be sealed: "
                    f"{error.strerror or error}; its events are safe and readable, and the next "
                    "start seals it"
                )
            except MapfoldError as error:
                self.error = LogError(f"{error}; run `mapfold log recover {self._log}`")
        if self._process is not None:
            self._process.close()

    def _seal(self, base: int) -> None:
        plan = SegmentPlan(self._log, self._log_id, base, self._previous_sha256)
        self._previous_sha256 = self._seal_aside(plan) or self._seal_here(plan)
        segment_path(self._log, base, ACTIVE).unlink()
        sync_directory(self._log)

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
