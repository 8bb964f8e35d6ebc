"""Sealing in a process of its own, for a recorder under load.

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
import subprocess
import sys
from pathlib import Path
from typing import IO, Any, Final, cast

from eventsrc.errors import LogDamaged

from ._active_file import ActiveFile
from ._naming import ACTIVE, SEALED, SEALING, segment_path
from ._seal import SegmentPlan, write_sealed
from .fsync import replace_durably, unlink_quietly

_NICE: Final = 10
"""Recording goes first, but not so far that sealing starves on a busy machine."""
_ENTRY: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from eventsrc.log._aside import serve; serve()"
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
