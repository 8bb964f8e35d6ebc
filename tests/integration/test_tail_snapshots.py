"""A tail starts from the latest snapshot of its own fold, and saves one."""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import Event, LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.snapshot_cache import SnapshotCache
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.live_fold import LiveFold
from tests.logs import append_raw, bridge, walk, write_log
from tests.rows import all_rows

SETTINGS = Settings()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(120) + list(bridge()) + walk(40, run_id="run-c"))


@pytest.fixture
def folded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The offsets that tails fold, in order."""
    offsets: list[int] = []
    feed = LiveFold.feed

    def spy(self: LiveFold, events: Sequence[Event]) -> Iterator[Any]:
        offsets.extend(event.offset for event in events)
        return feed(self, events)

    monkeypatch.setattr(LiveFold, "feed", spy)
    return offsets


def cache_of(log: Path, notes: list[str] | None = None) -> SnapshotCache:
    with LogReader(log) as reader:
        log_id = reader.log_id
    return SnapshotCache(log, log_id, SETTINGS, (notes if notes is not None else []).append)


def leave_snapshot(log: Path, offset: int) -> Path:
    with LogReader(log) as reader:
        cache_of(log).keep(*fold_log(reader, SETTINGS, offset, keep_embeddings=False))
    return next(cache_of(log).folder.glob(f"*-{offset:020d}.map"))


def test_a_tail_starts_at_the_snapshot_and_writes_the_rows_of_a_rebuild(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    rebuild(log, one_database, SETTINGS, until=110)
    for offset in (40, 90, 110, 130):
        leave_snapshot(log, offset)
    folded.clear()
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == 110
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_a_damaged_snapshot_is_reported_and_an_earlier_one_used(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    rebuild(log, one_database, SETTINGS, until=110)
    leave_snapshot(log, 40)
    damaged = leave_snapshot(log, 90)
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    notes: list[str] = []
    folded.clear()
    tail(log, one_database, SETTINGS, once=True, note=notes.append)
    assert folded[0] == 40
    assert [str(damaged) in note for note in notes] == [True]
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_no_snapshot_after_a_parked_event_is_used(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    leave_snapshot(log, 100)
    with LogReader(log) as reader:
        end = reader.next_offset
    append_raw(log, b'{"run_id": "run-z", "keyframe_id": "seven"}')
    write_log(log, walk(30, run_id="run-d"))
    first = tail(log, one_database, SETTINGS, once=True)
    assert [letter.offset for letter in first.parked] == [end]
    # As if another version, which can read that event, had left one.
    with LogReader(log) as reader:
        semantic_map, view = fold_log(reader, SETTINGS, end, keep_embeddings=False)
    semantic_map.next_offset = view.next_offset = end + 10
    cache_of(log).keep(semantic_map, view)
    write_log(log, walk(5, run_id="run-e"))
    folded.clear()
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == 100


def test_a_tail_saves_a_snapshot_if_it_folded_much(
    log: Path, one_database: Targets, folded: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["projections.postgres.tail_pass"], "SNAPSHOT_MIN_EVENTS", 50)
    report = tail(log, one_database, SETTINGS, once=True)
    assert cache_of(log).offsets() == [report.next_offset]
    write_log(log, walk(10, run_id="run-d"))
    folded.clear()
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == report.next_offset
    assert cache_of(log).offsets() == [report.next_offset]
