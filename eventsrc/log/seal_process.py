"""Seal segments in a process of their own, of lower priority, for a recorder.

Sealing takes half a processor at 20,000 events a second, and the thread that records would wait for
the interpreter lock of a thread that seals. So the process reads a finished segment and writes the
sealed one beside it, under a name with its own process id. The writer, which holds the lock of the
log, renames it. When the writer dies, the process finishes its segment, cannot send its reply,
deletes its file and ends. So no process of a dead writer changes a log that the next writer holds.

Synced bytes of a sealed segment are dropped from the page cache. A long recording would otherwise
fill the memory with segments that are not read soon, and new memory is slower to write to than
memory just used: in a virtual machine each event took 3 to 7 µs more.

One JSON document a line: a plan goes in, ``{"sha256": …, "temporary": …}`` or an error comes out.

The process is in a process group of its own, so Ctrl-C in a terminal reaches the writer only, which
ends it.
"""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import IO, Any, Final, cast

from eventsrc.base.errors import LogDamaged
from eventsrc.base.own_process import python_command

from .active_file import ActiveFile
from .durable_files import replace_durably, unlink_quietly
from .format import ACTIVE, SEALED, SEALING, segment_path
from .seal import SegmentPlan, write_sealed

_NICE: Final = 10
"""Recording has priority, but not so much that sealing starves on a busy machine."""
_PROGRAM: Final = "from eventsrc.log.seal_process import main; main()"


class ProcessGone(Exception):
    """The process cannot be started, or has died. Inside ``eventsrc.log`` only."""


class SealingProcess:
    """A running process that seals. Raises ProcessGone if it cannot be started."""

    def __init__(self) -> None:
        try:
            self._process = subprocess.Popen(  # noqa: S603 (our own code, no input in it)
                python_command(_PROGRAM),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # the writer then seals, and reports the same error
                process_group=0,
            )
        except OSError as error:
            raise ProcessGone(str(error)) from error
        self._input = cast("IO[bytes]", self._process.stdin)
        self._output = cast("IO[bytes]", self._process.stdout)

    def seal(self, plan: SegmentPlan) -> str:
        """Seal the active segment of ``plan``; returns the SHA-256 of the sealed file.

        Raises OSError or LogDamaged as `eventsrc.log.seal.seal` does, and ProcessGone if the
        process has died; the segment is then not sealed.
        """
        reply = self._request(
            {
                "log": str(plan.log.absolute()),
                "log_id": plan.log_id,
                "base": plan.base,
                "previous_sha256": plan.previous_sha256,
                "following": plan.following,
                "notes": plan.notes,
            }
        )
        if "errno" in reply:
            raise OSError(reply["errno"], reply["message"])
        if "damaged" in reply:
            raise LogDamaged(reply["damaged"])
        replace_durably(Path(reply["temporary"]), segment_path(plan.log, plan.base, SEALED))
        return str(reply["sha256"])

    def _request(self, request: dict[str, Any]) -> dict[str, Any]:
        try:
            self._input.write(json.dumps(request).encode() + b"\n")
            self._input.flush()
            reply: dict[str, Any] = json.loads(self._output.readline())
        except (OSError, ValueError) as error:
            self.close()
            unlink_quietly(_temporary(request, self._process.pid))
            raise ProcessGone(str(error)) from error
        return reply

    def close(self) -> None:
        """End the process and wait for it."""
        with contextlib.suppress(OSError):  # it has not read everything
            self._input.close()
        self._output.close()
        self._process.wait()


def main() -> None:
    """Run in the process: seal plan after plan, until the writer closes the standard input."""
    os.nice(_NICE)
    for line in sys.stdin:
        request = json.loads(line)
        temporary = _temporary(request, os.getpid())
        try:
            print(json.dumps(_reply_to(request, temporary)), flush=True)
        except OSError:  # the writer is gone
            unlink_quietly(temporary)
            os._exit(1)


def _temporary(request: dict[str, Any], pid: int) -> Path:
    return segment_path(Path(request["log"]), request["base"], f".{pid}{SEALING}")


def _reply_to(request: dict[str, Any], temporary: Path) -> dict[str, Any]:
    """Write the sealed segment to ``temporary``; the reply to the writer."""
    plan = SegmentPlan(**{**request, "log": Path(request["log"])})
    try:
        file = ActiveFile(segment_path(plan.log, plan.base, ACTIVE), plan.base)
        bodies = (file.read_chunk(chunk) for chunk in file.chunks)
        sha256 = write_sealed(plan, bodies, temporary, cached=False)
    except LogDamaged as error:
        return {"damaged": str(error)}
    except OSError as error:
        return {"errno": error.errno, "message": error.strerror or str(error)}
    return {"sha256": sha256, "temporary": str(temporary)}
