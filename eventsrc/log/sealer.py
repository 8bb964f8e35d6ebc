"""Seal finished segments in a background thread, in offset order.

The thread does it itself at a lower priority, or, for a recorder, has a process do the work. If the
process cannot be started or dies, the thread goes on by itself. Sealing may fall behind: a waiting
segment takes its full size on disk and is read as before. A failure costs no more than that; it is
tried again with the next segment and on the next start. Being killed in the middle costs nothing,
so the thread is a daemon.

Sealing takes half a processor at 20,000 events a second, and the thread that records would wait for
the interpreter lock of a thread that seals. So the process, of lower priority, reads a finished
segment and writes the sealed one beside it, under a name with its own process id. The writer, which
holds the lock of the log, renames it. When the writer dies, the process finishes its segment,
cannot send its reply, deletes its file and ends. So no process of a dead writer changes a log that
the next writer holds.

Synced bytes that the process sealed are dropped from the page cache. A long recording would
otherwise fill the memory with segments that are not read soon, and new memory is slower to write to
than memory just used: in a virtual machine each event took 3 to 7 µs more.
"""

import contextlib
import json
import os
import queue
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from eventsrc.base.errors import LogDamaged, LogError, MapfoldError
from eventsrc.base.text import advised
from eventsrc.base.worker_process import ProcessGone, WorkerProcess
from eventsrc.envelope.model import Offset

from .durable_files import replace_durably, sync_directory, unlink_quietly
from .format import ACTIVE, SEALED, SEALING, head_of, origin_notes, segment_path
from .seal import SegmentPlan, seal, write_sealed
from .sealed_end import SealedEnd, note_sealed
from .segment import ActiveFile

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_NICE: Final = 10
"""Recording has priority, but not so much that sealing starves on a busy machine."""


class SealingProcess(WorkerProcess):
    """A running process that seals. Raises ProcessGone if it cannot be started."""

    def __init__(self) -> None:
        super().__init__(_seal_plans)

    def seal(self, plan: SegmentPlan) -> str:
        """Seal the active segment of ``plan``; returns the SHA-256 of the sealed file.

        Raises OSError or LogDamaged as `eventsrc.log.seal.seal` does, and ProcessGone if the
        process has died; the segment is then not sealed.
        """
        request = {**asdict(plan), "log": str(plan.log.absolute())}
        try:
            self.send(json.dumps(request).encode())
            reply: dict[str, Any] = json.loads(self.receive())
        except ProcessGone:
            self.close()
            unlink_quietly(_temporary(plan, self.pid))
            raise
        if "errno" in reply:
            raise OSError(reply["errno"], reply["message"])
        if "damaged" in reply:
            raise LogDamaged(reply["damaged"])
        replace_durably(_temporary(plan, self.pid), segment_path(plan.log, plan.base, SEALED))
        return str(reply["sha256"])


def _seal_plans(connection: "Connection") -> None:
    """Run in the process: seal plan after plan, until the writer closes the connection."""
    os.nice(_NICE)
    while True:
        request = json.loads(connection.recv_bytes())
        plan = SegmentPlan(**{**request, "log": Path(request["log"])})
        temporary = _temporary(plan, os.getpid())
        try:
            connection.send_bytes(json.dumps(_sealed(plan, temporary)).encode())
        except OSError:  # the writer is gone
            unlink_quietly(temporary)
            raise


def _temporary(plan: SegmentPlan, pid: int) -> Path:
    return segment_path(plan.log, plan.base, f".{pid}{SEALING}")


def _sealed(plan: SegmentPlan, temporary: Path) -> dict[str, Any]:
    """Write the sealed segment to ``temporary``; the reply to the writer."""
    try:
        return {"sha256": write_sealed(plan, _bodies(plan), temporary, cached=False)}
    except LogDamaged as error:
        return {"damaged": str(error)}
    except OSError as error:
        return {"errno": error.errno, "message": error.strerror or str(error)}


def _bodies(plan: SegmentPlan) -> Iterator[bytes]:
    file = ActiveFile(segment_path(plan.log, plan.base, ACTIVE), plan.base)
    return (file.read_chunk(chunk) for chunk in file.chunks)


class Finished(NamedTuple):
    """A segment that is written to its end: offsets ``base`` to before ``following``."""

    base: Offset
    following: Offset


class Sealer:
    """`submit` segments in offset order; `finish` waits for all of them.

    With ``in_process`` a `SealingProcess` seals. It is started for the first segment, unless that
    is the last, because starting it takes longer than sealing a small one.
    """

    def __init__(
        self, log: Path, log_id: str, previous_sha256: str, *, in_process: bool = False
    ) -> None:
        self._in_process = in_process
        self._process: SealingProcess | None = None
        self._finishing = False
        self._log = log
        self._log_id = log_id
        self._previous_sha256 = self._sealed_sha256 = previous_sha256
        self._submitted: queue.Queue[Finished | None] = queue.Queue()
        self._damaged = False
        self._thread: threading.Thread | None = None
        self._count = self._sealed = 0
        self.error: LogError | None = None
        """Why the first waiting segment is not sealed; None again once it is."""

    @property
    def waiting(self) -> int:
        """Segments submitted and not sealed."""
        return self._count - self._sealed

    def submit(self, base: Offset, following: Offset, *, last: bool = False) -> None:
        """Queue the finished active segment of offsets ``base`` to before ``following``."""
        self._finishing = last
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mapfold-sealer", daemon=True)
            self._thread.start()
        self._count += 1
        self._submitted.put(Finished(base, following))

    def finish(self) -> None:
        """Wait until every segment submitted is sealed or has failed: see `error`."""
        if self._thread is not None:
            self._submitted.put(None)
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        _lower_priority()
        waiting: deque[Finished] = deque()
        while (finished := self._submitted.get()) is not None:
            waiting.append(finished)
            self._seal_all(waiting)
        self._seal_all(waiting)
        if self._process is not None:
            self._process.close()

    def _seal_all(self, waiting: deque[Finished]) -> None:
        """Seal in order, because each segment carries the hash of the one before. After an OSError
        the rest waits for the next call, after damage forever."""
        while waiting and not self._damaged:
            try:
                self._seal(waiting[0])
            except OSError as error:
                path = segment_path(self._log, waiting[0].base, ACTIVE)
                self.error = LogError(
                    f"{path} could not be sealed: {error.strerror or error}; its events are safe "
                    "and readable. It is tried again with the next segment and on the next start"
                )
                return
            except MapfoldError as error:
                self._damaged = True
                self.error = LogError(f"{error}; run `{advised('log', 'recover', self._log)}`")
            else:
                self.error = None
                self._sealed += 1
                waiting.popleft()

    def _seal(self, segment: Finished) -> None:
        base, following = segment
        active = segment_path(self._log, base, ACTIVE)
        # Without the active file an earlier call sealed it, and only the sync of the folder failed.
        if active.exists():
            notes = origin_notes(head_of(active, base))
            previous = self._previous_sha256
            plan = SegmentPlan(self._log, self._log_id, base, previous, following, notes)
            self._sealed_sha256 = self._seal_in_process(plan) or seal(plan, _bodies(plan))
            note_sealed(self._log, SealedEnd(self._log_id, base, following))
            active.unlink()
        elif not segment_path(self._log, base, SEALED).exists():
            lost = f"offsets {base} to {following - 1} are lost"
            raise LogDamaged(f"{active} was deleted before it was sealed: {lost}")
        sync_directory(self._log)
        self._previous_sha256 = self._sealed_sha256

    def _seal_in_process(self, plan: SegmentPlan) -> str | None:
        """The SHA-256 of the sealed file; None if this thread must seal."""
        try:
            if self._process is None and self._in_process and not self._finishing:
                self._process = SealingProcess()
            return None if self._process is None else self._process.seal(plan)
        except ProcessGone:
            self._in_process, self._process = False, None
            return None


def _lower_priority() -> None:
    """Lower the priority of this thread, where threads have their own (Linux)."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
