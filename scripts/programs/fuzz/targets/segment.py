"""A segment of a log, growing and sealed: read, verified and recovered, with LogErrors at worst."""

import random
import shutil
from collections.abc import Sequence
from pathlib import Path

from eventsrc.base.errors import LogError
from eventsrc.log import LogReader, LogWriter, recover_log, verify_log
from eventsrc.log.segment import Unreadable
from scripts.programs.fuzz.mcap_mutation import mutate_mcap
from scripts.programs.fuzz.scratch import scratch
from scripts.programs.fuzz.target import Target
from tests.support.fixtures_log import BY_HAND, KEY, envelope

MOST_EVENTS = 101_000
"""Recovery adds 100,000 losses unasked, besides those that the damaged bytes can have held."""
NAME = "00000000000000000000.mcap"


class SegmentTarget(Target):
    """The bytes of a log's only segment."""

    def seeds(self) -> Sequence[bytes]:
        """One that was killed, and one that was sealed."""
        log = scratch() / "seed"
        writer = LogWriter(log, fsync=BY_HAND)
        for k in range(6):
            writer.append(KEY if k % 2 else "mapfold/loss", envelope(k))
            if k % 2:
                writer.sync()
        growing = (log / f"{NAME}.active").read_bytes()
        writer.close()
        sealed = (log / NAME).read_bytes()
        shutil.rmtree(log)
        return [growing, sealed]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One record, below the checksums."""
        return mutate_mcap(data, rng)

    def check(self, data: bytes) -> None:
        """Under either name: what is read is in order, what is recovered is whole."""
        for name in (NAME, f"{NAME}.active"):
            log = scratch() / "log"
            shutil.rmtree(log, ignore_errors=True)
            log.mkdir()
            (log / name).write_bytes(data)
            self._check_log(log)

    def _check_log(self, log: Path) -> None:
        try:
            before = _readable(log)
            verify_log(log)
            recover_log(log)
        except LogError:
            return
        after = _readable(log)
        assert set(before) <= set(after)
        assert after == [*range(len(after))]
        assert len(after) <= MOST_EVENTS
        assert recover_log(log).segments == ()


def _readable(log: Path) -> list[int]:
    gaps: list[Unreadable] = []
    try:
        with LogReader(log) as reader:
            offsets = [event.offset for event in reader.read(on_gap=gaps.append)]
    except LogError:
        return []
    assert offsets == sorted(set(offsets))
    return offsets
