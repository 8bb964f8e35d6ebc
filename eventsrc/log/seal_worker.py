"""Seals finished segments beside the recording, one after the other, in a thread of its own.

Compressing and hashing release the interpreter lock, so recording goes on; for a recorder the
thread has a process do the work (`_aside`), and does it itself when there is none to be had.
Recording goes first: while it is in a hurry sealing waits, until so many segments wait that it is
their turn, and it may fall behind anyway. That costs disk (a segment waits at its full size), and
no more. What fails here costs nothing either: the active file stays, is read as before, and is
tried again, on the next start at the latest. Nor does it cost anything to be stopped in the middle,
so the thread keeps no process alive that forgot to close.

Sealing in a process of its own, for a recorder under load.

Compressing takes a core as long as recording does, and a thread beside the writer's would fight it
for the interpreter lock. So the work, and nothing else, is done elsewhere: the process reads a
finished segment and writes the sealed one beside it, under a name with its own id. Putting that in
place is left to the writer, who holds the log's lock; when the writer dies the process ends with
the segment at hand and puts nothing anywhere. It is started at a lower priority, and outside the
terminal's process group, so that Ctrl-C leaves it to the writer to end it.

One JSON document a line: a plan comes in, ``{"sha256": …, "temporary": …}`` or the error goes out.

The process imports from where its parent does and nowhere else: a file in the current folder that
happens to be named like a module must not get into it.
"""

import contextlib
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, cast

from eventsrc.envelope import Offset
from eventsrc.errors import LogDamaged, LogError, MapfoldError

from .active_file import ActiveFile
from .durable_files import replace_durably, sync_directory, unlink_quietly
from .format import ACTIVE, SEALED, SEALING, segment_path
from .seal import SegmentPlan, seal, write_sealed

_NICE: Final = 10
"""Recording goes first, but not so far that sealing starves on a busy machine."""
_ENTRY: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from eventsrc.log.seal_worker import serve; serve()"
)


class ProcessGone(Exception):
    """The process cannot be started or has died. Inside ``eventsrc.log`` only."""


class SealingProcess:
    """``seal`` as `_seal.seal` does, in a process that lives until `close`."""

    def __init__(self) -> None:
        try:
            self._process = subprocess.Popen(  # noqa: S603 (our own code, no input in it)
                [sys.executable, "-P", "-c", _ENTRY, json.dumps(sys.path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                process_group=0,
            )
        except OSError as error:
            raise ProcessGone(str(error)) from error
        self._to = cast("IO[bytes]", self._process.stdin)
        self._from = cast("IO[bytes]", self._process.stdout)

    def seal(self, plan: SegmentPlan) -> str:
        """Seal the active segment of ``plan``; the new file's SHA-256. Raises OSError or LogDamaged
        as sealing in this process would, and ProcessGone when there is nobody left to do it."""
        answer = self._ask(
            {
                "log": str(plan.log.absolute()),
                "log_id": plan.log_id,
                "base": plan.base,
                "previous_sha256": plan.previous_sha256,
                "following": plan.following,
            }
        )
        if "errno" in answer:
            raise OSError(answer["errno"], answer["message"])
        if "damaged" in answer:
            raise LogDamaged(answer["damaged"])
        replace_durably(Path(answer["temporary"]), segment_path(plan.log, plan.base, SEALED))
        return str(answer["sha256"])

    def _ask(self, question: dict[str, Any]) -> dict[str, Any]:
        try:
            self._to.write(json.dumps(question).encode() + b"\n")
            self._to.flush()
            answer: dict[str, Any] = json.loads(self._from.readline())
        except (OSError, ValueError) as error:
            self.close()
            unlink_quietly(_temporary(question, self._process.pid))
            raise ProcessGone(str(error)) from error
        return answer

    def close(self) -> None:
        """End the process and wait for it."""
        with contextlib.suppress(OSError):  # what it did not read any more
            self._to.close()
        self._from.close()
        self._process.wait()


def serve() -> None:
    """The process: answer plans until there are no more."""
    os.nice(_NICE)
    for line in sys.stdin:
        question = json.loads(line)
        temporary = _temporary(question, os.getpid())
        try:
            print(json.dumps(answer(question, temporary)), flush=True)
        except OSError:  # the writer is gone, and this is nobody's file
            unlink_quietly(temporary)
            os._exit(1)


def _temporary(question: dict[str, Any], pid: int) -> Path:
    return segment_path(Path(question["log"]), question["base"], f".{pid}{SEALING}")


def answer(question: dict[str, Any], temporary: Path) -> dict[str, Any]:
    """Write the segment asked for to ``temporary``; what to say of it."""
    plan = SegmentPlan(**{**question, "log": Path(question["log"])})
    try:
        file = ActiveFile(segment_path(plan.log, plan.base, ACTIVE), plan.base)
        sha256 = write_sealed(plan, (file.read_chunk(c) for c in file.chunks), temporary)
    except LogDamaged as error:
        return {"damaged": str(error)}
    except OSError as error:
        return {"errno": error.errno, "message": error.strerror or str(error)}
    return {"sha256": sha256, "temporary": str(temporary)}


_MOST_WAITING: Final = 256
"""Segments that wait at most for the sake of a recording in a hurry, 16 GiB …"""
_FREE_DISK_SHARE: Final = 4
"""… and never more than this part of the disk that is free."""
_LOOK_AGAIN_S: Final = 0.25


class Finished(NamedTuple):
    """A segment that was written to its end: its offsets are ``base`` to before ``following``."""

    base: Offset
    following: Offset


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

    def submit(self, base: Offset, following: Offset, *, last: bool = False) -> None:
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
