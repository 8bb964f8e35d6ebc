"""Objects that a `same-object` command makes one: the absorbed vertex goes, its edges move."""

from pathlib import Path

import pytest

from eventsrc.envelope.commands import SameObject
from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.graph_rows import expected_rows
from projections.postgres.live_fold import LiveFold, batches
from tests.support.envelopes import detection, envelope
from tests.support.logs import append_command, command, walk, write_log
from tests.support.memory_sink import MemorySink, MemoryTables
from tests.support.rows import all_rows, expected_graph, followed_and_rebuilt, parsed

SETTINGS = Settings()


def fold(log: Path) -> tuple[MapView, Corrections]:
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return fold_log(reader, SETTINGS, corrections=corrections)[1], corrections


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The command is recorded before the robot sees the two Objects."""
    documents = walk(80)
    plain, _ = fold(write_log(tmp_path / "plain", documents))
    pairs = (
        (a, b)
        for a in plain.objects.values()
        for b in plain.objects.values()
        if a.ordinal < b.ordinal and a.place is not None and b.place not in (None, a.place)
    )
    pair = max(pairs, key=lambda pair: pair[1].obs_count)
    det_ids = tuple(plain.observations[thing.observations[-1]].det_id for thing in pair)
    log = write_log(tmp_path / "log", [])
    append_command(log, command(SameObject, det_ids=det_ids))
    return write_log(log, documents)


def test_live_rows_and_a_rebuild_are_what_the_view_says(
    log: Path, one_database: Targets, third_database: Targets
) -> None:
    view, _ = fold(log)
    assert len(view.objects) == len(view.all_objects) - 1
    tail(log, one_database, SETTINGS, once=True, batch_events=7)
    rebuild(log, third_database, SETTINGS)
    rows = all_rows(one_database)
    assert rows == all_rows(third_database)
    assert parsed(rows[0]) == expected_graph(view)


@pytest.mark.parametrize("size", [1, 7, 1_000])
def test_batches_of_any_size_give_the_rows_of_a_rebuild(log: Path, size: int) -> None:
    _, corrections = fold(log)
    live, fresh = followed_and_rebuilt(log, SETTINGS, size, corrections)
    assert live.graph == fresh.graph


def test_an_object_is_found_and_absorbed_by_one_event(tmp_path: Path) -> None:
    """The first detection of the second keyframe founds an Object far from the other one; the
    second detection joins it and is, by command, of the other one."""
    documents = [
        envelope(0, 0.0, detections=[detection("cup", [1.0, 0.0], det_id="a")]),
        envelope(
            1,
            100.0,
            detections=[
                detection("cup", [0.0, 1.0], det_id="b"),
                detection("cup", [0.0, 1.0], det_id="c"),
            ],
        ),
    ]
    log = write_log(tmp_path / "log", [])
    append_command(log, command(SameObject, det_ids=("a", "c")))
    write_log(log, documents)
    view, corrections = fold(log)
    assert [o.obs_count for o in view.objects.values()] == [3]
    following, live = LiveFold(SETTINGS, corrections=corrections), MemoryTables()
    with LogReader(log) as reader:
        for batch in batches(reader.read(FIRST_OFFSET), 1):
            assert not any(following.feed(batch))
            MemorySink().prepare(following.tracker.drain(), following.view).send(live)
    assert list(live.graph["Object"]) == [row[0] for row in expected_rows(view, "Object")]
    assert list(live.graph["OBSERVES"].values()) == list(expected_rows(view, "OBSERVES"))
