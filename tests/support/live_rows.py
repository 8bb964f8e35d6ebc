"""Rows of a log that is followed batch by batch, beside those of a rebuild, in memory."""

from pathlib import Path

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.settings import Settings
from projections.postgres.live_fold import LiveFold, batches
from projections.postgres.memory_sink import MemorySink, MemoryTables


def followed_and_rebuilt(
    log: Path, settings: Settings, size: int, corrections: Corrections = NO_CORRECTIONS
) -> tuple[MemoryTables, MemoryTables]:
    """The tables of a tail and those of a rebuild, both in batches of ``size`` events."""
    live, fresh = MemoryTables(), MemoryTables()
    following, folding = (LiveFold(settings, corrections=corrections) for _ in range(2))
    sink, shadow = MemorySink(), MemorySink().shadow()
    with LogReader(log) as reader:
        for batch in batches(reader.read(FIRST_OFFSET), size):
            assert not any(following.feed(batch))
            sink.prepare(following.tracker.drain(), following.view).send(live)
            assert not any(folding.feed(batch))
            shadow.load(folding.tracker.drain(), folding.view)(fresh)
    shadow.finish(folding.view)(fresh)
    shadow.swap_in(fresh)
    return live, fresh
