"""Digests of past maps are kept beside the log, and are those of the maps.

`tests/property/test_timeline_cache.py` compares them with computed ones, whatever became of the log
and of the files.
"""

from pathlib import Path
from unittest.mock import patch

import pytest

from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS
from projections.history import LogTimeline
from projections.map.digest import map_digest
from projections.map.fold import fold_events, fold_log, new_map
from projections.map.view import MapView
from projections.store.timeline_cache import MOST_DIGESTS
from tests.integration.test_timeline_cache_attacked import EVENTS, drive
from tests.property.test_timeline_cache import kept_early
from tests.support.histories import RULES
from tests.support.walks import write_log

ENDS = [1, 50, EVENTS]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", drive(0, EVENTS))


def digests(log: Path, ends: list[int], *, cache: bool = True) -> list[str]:
    with kept_early(), LogTimeline(log, RULES, cache=cache) as timeline:
        _ = timeline.history
        return [map_digest(timeline.at(end)) for end in ends]


def files(log: Path) -> list[Path]:
    return sorted(log.with_name("log.history").glob("*.digest"))


def none_is_computed(_: MapView) -> str:
    raise AssertionError("a digest is computed")


def test_the_second_who_asks_gets_the_digest_that_was_kept(log: Path) -> None:
    right = digests(log, ENDS, cache=False)
    assert not files(log)
    assert digests(log, ENDS) == right
    assert len(files(log)) == len(ENDS)
    with patch("projections.map.digest._computed", none_is_computed):
        assert digests(log, ENDS) == right
        with pytest.raises(AssertionError, match="a digest is computed"):
            digests(log, [51])


def test_a_map_that_was_folded_on_has_a_digest_of_its_own(log: Path) -> None:
    digests(log, ENDS)
    with kept_early(), LogTimeline(log, RULES) as timeline, LogReader(log) as reader:
        view = timeline.at(EVENTS // 2)
        semantic_map = new_map(reader, RULES, NO_CORRECTIONS)
        for folded in fold_events(reader.read(), semantic_map):
            if folded.offset >= EVENTS // 2:
                view.apply_event(folded.offset, folded.deltas)
        with (
            pytest.raises(AssertionError),
            patch("projections.map.digest._computed", none_is_computed),
        ):
            map_digest(view)
        assert map_digest(view) == map_digest(fold_log(reader, RULES)[1])


def test_digests_are_few(log: Path) -> None:
    ends = list(range(1, 2 * MOST_DIGESTS))
    digests(log, ends)
    assert len(files(log)) == MOST_DIGESTS
    assert any(f"-{ends[-1]:020d}." in path.name for path in files(log))


def test_a_damaged_digest_is_named_and_computed_again(log: Path) -> None:
    right = digests(log, [50])
    (path,) = files(log)
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    notes: list[str] = []
    with kept_early(), LogTimeline(log, RULES, note=notes.append) as timeline:
        assert map_digest(timeline.at(50)) == right[0]
    assert notes == [f"{path} is not used: its checksum does not match"]
    with patch("projections.map.digest._computed", none_is_computed):
        assert digests(log, [50]) == right
