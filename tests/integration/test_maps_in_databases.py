"""A log with an occupancy map in the databases: tail, rebuild and check agree, under both rules of
places; what is no map is parked like any event that cannot be folded."""

from pathlib import Path

import pytest

from eventsrc.log import LogReader, LogWriter
from eventsrc.system_events import MAP_KEY
from projections.database import rebuild, tail
from projections.database.check import check
from projections.database.connection import Targets
from projections.model.fold import fold_log
from projections.settings import Settings
from tests.envelopes import envelope, payload
from tests.fixtures_log import KEY
from tests.maps import drawn_map
from tests.rows import all_rows

ROOMS = drawn_map("########## #...#....# #...#....# #........# ##########", 1.0, (-2.0, -2.0, 0.0))
EAST = [envelope(k, 4.0 - 0.25 * (k % 4), 0.0) for k in range(8)]
WEST = [envelope(k, 1.7 - 0.25 * (k % 4), 0.0) for k in range(8, 16)]


def _log(path: Path, content: bytes) -> Path:
    with LogWriter(path) as writer:
        writer.append(MAP_KEY, content)
        for document in [*EAST, *WEST]:
            writer.append(KEY, payload(document))
    return path


@pytest.mark.parametrize("places", ["page", "rooms"])
def test_tail_rebuild_and_check_agree(tmp_path: Path, one_database: Targets, places: str) -> None:
    log = _log(tmp_path / "log", ROOMS.encode())
    settings = Settings.model_validate({"places": places})
    assert tail(log, one_database, settings, once=True).next_offset == 17
    tailed = all_rows(one_database)
    with LogReader(log) as reader:
        view = fold_log(reader, settings)[1]
    assert len(view.places) == 2
    rebuild(log, one_database, settings)
    assert all_rows(one_database) == tailed
    assert [r.differing for r in check(log, one_database, settings)] == [0, 0]


def test_what_is_no_map_is_parked(tmp_path: Path, one_database: Targets) -> None:
    log = _log(tmp_path / "log", b'{"resolution": 0}')
    report = tail(log, one_database, Settings(), once=True)
    assert [letter.offset for letter in report.parked] == [0]
    assert report.next_offset == 17
