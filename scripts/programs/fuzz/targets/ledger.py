"""A saved gap ledger beside its log: believed only if it is right, recounted if not."""

import random
import shutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from eventsrc.envelope.gaps import GapLedger
from eventsrc.log import NEVER, LogReader, LogWriter
from eventsrc.record.gap_history import ledger_of, save_ledger
from scripts.programs.attack.corruption import corrupt_json
from scripts.programs.fuzz.scratch import scratch
from scripts.programs.fuzz.target import Target
from tests.support.fixtures_log import KEY, envelope

NAME = ".ledger.json"
SEEN = (0, 1, 2, 5, 6, 9)


class LedgerTarget(Target):
    """The bytes of ``.ledger.json``."""

    def seeds(self) -> Sequence[bytes]:
        """The right one."""
        log = _log()
        with LogReader(log) as reader:
            save_ledger(log, reader.log_id, reader.next_offset, _recount(log))
        return [(log / NAME).read_bytes()]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One value becomes another."""
        return corrupt_json(data, rng)

    def check(self, data: bytes) -> None:
        """Whatever the file says, the ledger is that of the log."""
        log = _log()
        (log / NAME).write_bytes(data)
        with LogReader(log) as reader:
            found = ledger_of(reader, now_ns=0)
        assert found.state() == _recount(log).state()
        assert found.missing == _recount(log).missing


@cache
def _log() -> Path:
    log = scratch() / "counted"
    shutil.rmtree(log, ignore_errors=True)
    with LogWriter(log, fsync=NEVER) as writer:
        for run_id in ("a", "b"):
            for k in SEEN:
                writer.append(KEY, envelope(k, run_id=run_id))
    return log


@cache
def _recount(log: Path) -> GapLedger:
    (log / NAME).unlink(missing_ok=True)
    with LogReader(log) as reader:
        return ledger_of(reader, now_ns=0)
