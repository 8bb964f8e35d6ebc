"""The first map a timeline gives comes from a snapshot; losing or damaging any changes nothing."""

import tempfile
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.history import Timeline
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.snapshot_cache import SnapshotCache
from tests.fixtures_timetravel import walks, write_log
from tests.thorough import examples

RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)


@settings(deadline=None, max_examples=examples(40), suppress_health_check=[HealthCheck.too_slow])
@given(walks(most=24), st.data())
def test_at_is_the_same_whatever_snapshots_are_left(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    offsets = data.draw(st.lists(st.integers(0, len(documents)), max_size=4, unique=True))
    lost = data.draw(st.lists(st.sampled_from(["kept", "deleted", "damaged"]), min_size=4))
    asked = data.draw(st.lists(st.integers(0, len(documents)), min_size=1, max_size=3))
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        with LogReader(log) as reader:
            expected = [map_digest(fold_log(reader, RULES, end)[1]) for end in asked]
            keep_snapshots(reader, offsets)
        for path, fate in zip(
            sorted((Path(folder) / "log.snapshots").glob("*")), lost, strict=False
        ):
            spoil(path, fate)
        notes: list[str] = []
        with Timeline(log, RULES, note=notes.append) as timeline:
            views = [timeline.at(end) for end in asked]
            later = timeline.at(asked[0])
            for event in timeline.deltas(asked[0]):
                later.apply_event(event.offset, event.deltas)
            assert map_digest(later) == map_digest(timeline.at())
        assert [map_digest(view) for view in views] == expected
        assert [view.next_offset for view in views] == asked
        assert all("this snapshot is not used" in note for note in notes)


def keep_snapshots(reader: LogReader, offsets: list[int]) -> None:
    for offset in offsets:
        cache = SnapshotCache(reader.path, reader.log_id, RULES, lambda _: None)
        cache.keep(*fold_log(reader, RULES, offset, keep_embeddings=False))


def spoil(path: Path, fate: str) -> None:
    if fate == "deleted":
        path.unlink()
    elif fate == "damaged":
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
