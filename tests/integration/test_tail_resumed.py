"""A tail starts from the latest kept fold of its own map, and keeps what it folds."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from eventsrc.envelope.model import Offset
from eventsrc.log import Event, LogReader, cache_folder
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.map.digest import map_digest
from projections.map.fold import FoldedEvent, fold_events
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.live_fold import LiveFold
from projections.store.history_recorder import map_after
from tests.property.test_timeline_cache import kept_early
from tests.support.logs import append_command, append_raw, bridge, name_place, walk, write_log
from tests.support.rows import all_rows

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


@pytest.fixture(autouse=True)
def short_histories() -> Iterator[None]:
    """Histories of any length are kept."""
    with kept_early():
        yield


def keep_fold(log: Path, end: int) -> Path:
    """Fold up to ``end`` and keep the history; the file of the fold."""
    with LogReader(log) as reader:
        map_after(reader, SETTINGS, Offset(end))
    return next(cache_folder(log).glob(f"*-{end:020d}.fold"))


def folds_kept(log: Path) -> list[int]:
    return sorted(int(path.stem[-20:]) for path in cache_folder(log).glob("*.fold"))


def test_a_tail_starts_at_a_kept_fold_and_writes_the_rows_of_a_rebuild(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    rebuild(log, one_database, SETTINGS, until=110)
    for end in (40, 90, 110, 130):
        keep_fold(log, end)
    assert folds_kept(log) == [90, 110, 130]
    folded.clear()
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == 110
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_a_damaged_fold_is_reported_and_an_earlier_one_used(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    rebuild(log, one_database, SETTINGS, until=110)
    keep_fold(log, 40)
    damaged = keep_fold(log, 90)
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


def test_no_fold_after_a_parked_event_is_used(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    keep_fold(log, 100)
    with LogReader(log) as reader:
        end = reader.next_offset
    append_raw(log, b'{"run_id": "run-z", "keyframe_id": "seven"}')
    write_log(log, walk(30, run_id="run-d"))
    first = tail(log, one_database, SETTINGS, once=True)
    assert [letter.offset for letter in first.parked] == [end]
    assert folds_kept(log) == [100]
    # As if another version, which can read that event, had kept one.
    with patch("projections.store.history_recorder.fold_events", passing_over(end)):
        keep_fold(log, end + 10)
    write_log(log, walk(5, run_id="run-e"))
    folded.clear()
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == 100


def passing_over(offset: int) -> Callable[..., Iterator[FoldedEvent]]:
    """A fold of events that takes the one at ``offset`` for one that changes nothing."""

    def folding(events: Iterable[Event], semantic_map: SemanticMap, **given: Any) -> Any:
        for event in events:
            if event.offset == offset:
                semantic_map.skip(offset)
                yield FoldedEvent(offset, [])
            else:
                yield from fold_events([event], semantic_map, **given)

    return folding


def test_a_tail_keeps_what_it_folded(log: Path, one_database: Targets, folded: list[int]) -> None:
    report = tail(log, one_database, SETTINGS, once=True)
    assert folds_kept(log) == [report.next_offset]
    with LogTimeline(log, SETTINGS) as kept, LogTimeline(log, SETTINGS, cache=False) as made:
        with patch.object(SemanticMap, "fold", side_effect=AssertionError):
            digests = [map_digest(kept.at(end)) for end in (1, 50, 120, kept.end)]
        assert digests == [map_digest(made.at(end)) for end in (1, 50, 120, made.end)]
    write_log(log, walk(10, run_id="run-d"))
    folded.clear()
    again = tail(log, one_database, SETTINGS, once=True)
    assert folded[0] == report.next_offset
    assert folds_kept(log) == [report.next_offset, again.next_offset]


def test_a_tail_goes_on_from_a_fold_under_other_names(
    log: Path, one_database: Targets, folded: list[int]
) -> None:
    first = tail(log, one_database, SETTINGS, once=True)
    append_command(log, name_place(1, "hall"))
    write_log(log, walk(10, run_id="run-d"))
    tail(log, one_database, SETTINGS, once=True)
    folded.clear()
    write_log(log, walk(10, run_id="run-e"))
    tail(log, one_database, SETTINGS, once=True)
    assert folded[0] >= first.next_offset
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed
