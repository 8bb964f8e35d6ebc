"""Seals finished segments beside the recording, one after the other, in a thread of its own.

Compressing and hashing release the interpreter lock, so recording goes on. What fails here costs
nothing: the active file stays, is read as before, and is sealed on the next start. Nor does it cost
anything to be stopped in the middle, so the thread keeps no process alive that forgot to close.
"""

import queue
import threading
from pathlib import Path

from eventsrc.errors import LogError, MapfoldError

from ._active_file import ActiveFile
from ._naming import ACTIVE, segment_path
from ._seal import SegmentPlan, seal
from .fsync import sync_directory


class Sealer:
    """``submit`` bases in offset order; ``finish`` waits for all of them."""

    def __init__(self, log: Path, log_id: str, previous_sha256: str) -> None:
        self._log = log
        self._log_id = log_id
        self._previous_sha256 = previous_sha256
        self._bases: queue.Queue[int | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self.error: LogError | None = None

    def submit(self, base: int) -> None:
        """Seal the finished active segment at ``base`` when its turn comes."""
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

    def _seal(self, base: int) -> None:
        path = segment_path(self._log, base, ACTIVE)
        file = ActiveFile(path, base)
        plan = SegmentPlan(self._log, self._log_id, base, self._previous_sha256)
        self._previous_sha256 = seal(plan, (file.read_chunk(chunk) for chunk in file.chunks))
        path.unlink()
        sync_directory(self._log)
