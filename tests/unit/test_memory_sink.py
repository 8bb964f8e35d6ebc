"""The port of sinks without a database: batches of any size and a rebuild give the same rows."""

from pathlib import Path

import pytest

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.postgres.labels import COUNT_KEYS, LABELS, TABLE
from projections.postgres.live_fold import LiveFold, batches
from projections.postgres.sink import Sink
from tests.support.logs import bridge, walk, write_log
from tests.support.memory_sink import MemorySink, MemoryTables

SETTINGS = Settings()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Places that merge, objects that move, edges that come and go."""
    return write_log(tmp_path / "log", walk(60) + list(bridge()) + walk(40, run_id="run-c"))


def followed(log: Path, size: int, start: int = 0) -> tuple[LiveFold, MemoryTables]:
    """The rows of a sink that got the log in batches, from an offset on."""
    fold, tables, sink = LiveFold(SETTINGS), MemoryTables(), MemorySink()
    live: Sink[MemoryTables] = sink
    assert not live.ensure(tables)
    with LogReader(log) as reader:
        for batch in batches(reader.read(FIRST_OFFSET), size, [start]):
            assert not any(fold.feed(batch))
            changes = fold.tracker.drain()
            if batch[0].offset >= start:
                prepared = live.prepare(changes, fold.view)
                prepared.send(tables)
                prepared.send(tables)  # again, as after a failed commit
    return fold, tables


def rebuilt(log: Path, size: int, tables: MemoryTables) -> tuple[LiveFold, dict[str, int]]:
    fold, rebuilds = LiveFold(SETTINGS), MemorySink()
    sink: Sink[MemoryTables] = rebuilds
    sink.drop_leftovers(tables)
    shadow = sink.shadow()
    shadow.create(tables)
    with LogReader(log) as reader:
        for batch in batches(reader.read(FIRST_OFFSET), size):
            assert not any(fold.feed(batch))
            shadow.load(fold.tracker.drain(), fold.view)(tables)
    rows = shadow.finish(fold.view)(tables)
    shadow.lock_readers(tables)
    shadow.swap_in(tables)
    sink.drop_replaced(tables)
    return fold, dict(rows)


@pytest.mark.parametrize("size", [1, 7, 1_000])
def test_batches_of_any_size_give_the_rows_of_a_rebuild(log: Path, size: int) -> None:
    fold, tables = followed(log, size)
    fresh = MemoryTables()
    _, rows = rebuilt(log, 50, fresh)
    assert tables.graph == fresh.graph
    assert tables.vectors.keys() == fresh.vectors.keys()
    assert all(
        row.det_pk == key and row.added.det_id == fresh.vectors[key].added.det_id
        for key, row in tables.vectors.items()
    )
    counts = fold.view.counts()
    assert {label: rows[label] for label in LABELS} == {
        label: counts[COUNT_KEYS[label]] for label in LABELS
    }
    assert rows[TABLE] == len(tables.vectors) > 0


def test_readers_see_the_old_rows_until_the_swap(log: Path) -> None:
    fold, tables = followed(log, 20)
    before = {label: dict(rows) for label, rows in tables.graph.items()}
    shadow = MemorySink().shadow()
    shadow.create(tables)
    shadow.load(fold.tracker.drain(), fold.view)(tables)
    shadow.finish(fold.view)(tables)
    assert tables.graph == before


def test_a_batch_ends_where_a_sink_begins(log: Path) -> None:
    """A sink that has the events below 30 gets those from 30 on and no others."""
    _, whole = followed(log, 1_000)
    fold, late = followed(log, 1_000, start=30)
    assert late.graph["Keyframe"].keys() < whole.graph["Keyframe"].keys()
    added = {key for key in whole.graph["Keyframe"] if key not in late.graph["Keyframe"]}
    assert len(added) == sum(k.offset < 30 for k in fold.view.keyframes) > 0
