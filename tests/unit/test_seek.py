"""Points in a log: offsets, times, keyframes and the end."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.log import LogReader, LogWriter, Unreadable
from eventsrc.log import seal as _parts
from eventsrc.log.seek import resolve, resolve_start
from tests.support.fixtures_log import BY_HAND, KEY, envelope, flip

SECOND = 1_000_000_000


@pytest.fixture
def reader(log_path: Path) -> Iterator[LogReader]:
    """Run a: keyframes 1, 2, 3 at seconds 10, 20, 30; a loss; run a:b: keyframe 2 at second 15;
    a duplicate of a:2 at second 20."""
    with LogWriter(log_path) as writer:
        for run_id, keyframe_id, second in [("a", 1, 10), ("a", 2, 20), ("a", 3, 30)]:
            writer.append(KEY, envelope(keyframe_id, run_id), stamp_ns=second * SECOND)
        writer.append("mapfold/loss", b'{"keyframe_id": 7, "run_id": "a"}', stamp_ns=31 * SECOND)
        writer.append(KEY, envelope(2, "a:b"), stamp_ns=15 * SECOND)
        writer.append(KEY, envelope(2, "a"), stamp_ns=20 * SECOND)
    with LogReader(log_path) as reader:
        yield reader


@pytest.mark.parametrize(
    ("text", "count", "start"),
    [
        ("0", 0, 0),
        ("4", 4, 4),
        ("6", 6, 6),
        ("end", 6, 6),
        ("0" * 5_000 + "4", 4, 4),
        ("a:1", 1, 0),
        ("a:" + "0" * 5_000 + "2", 2, 1),
        ("a:2", 2, 1),
        ("a:b:2", 5, 4),
        ("1970-01-01T00:00:09Z", 0, 0),
        ("1970-01-01T00:00:10Z", 1, 0),
        ("1970-01-01T00:00:15", 5, 1),
        ("1970-01-01T01:00:15+01:00", 5, 1),
        ("1970-01-01T00:00:19.999999Z", 5, 1),
        ("1970-01-01T00:00:20Z", 6, 1),
        ("1970-01-02", 6, 6),
    ],
)
def test_points(reader: LogReader, text: str, count: int, start: int) -> None:
    assert resolve(reader, text) == count
    assert resolve_start(reader, text) == start


@pytest.mark.parametrize(
    "text", ["7", "-1", "a:4", "a:7", "b:1", "soon", "", ":", "a:", ":1", "²", "1970-13-01"]
)
def test_a_point_that_is_not_in_the_log_is_an_error(reader: LogReader, text: str) -> None:
    for ask in (resolve, resolve_start):
        with pytest.raises(MisuseError) as caught:
            ask(reader, text)
        assert text in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("9" * 5_000, "9999… is beyond the end of "),
        ("9" * 20, "99999999999999999999 is beyond the end of "),
        ("a:" + "9" * 5_000, "9999…: {} has no such keyframe"),
        ("-" + "9" * 5_000, "9999…' is no point in a log; give an offset"),
        (
            "09:02:06",
            "09:02:06: {} has no such keyframe, nor is this a time, which is written with",
        ),
        ("2026-13-01T09:02", "2026-13-01T09:02: {} has no such keyframe, nor is this a time"),
        ("2026-13-01", "'2026-13-01' is no point in a log; give an offset, a time such as 2026"),
        ("b:007", "b:007: {} has no such keyframe; `mapfold log cat {}` lists what it has"),
    ],
)
def test_the_error_quotes_the_point_as_written(reader: LogReader, text: str, says: str) -> None:
    with pytest.raises(MisuseError) as caught:
        resolve(reader, text)
    assert says.replace("{}", str(reader.path)) in str(caught.value)


@pytest.mark.parametrize(
    ("second", "told"), [(9, None), (10, None), (15, "of the 5 events"), (20, "of the 6 events")]
)
def test_later_events_in_a_range_up_to_a_time_are_reported(
    reader: LogReader, second: int, told: str | None
) -> None:
    lines: list[str] = []
    resolve(reader, _at(second), note=lines.append)
    assert len(lines) == (told is not None)
    for line in lines:
        assert f"{told} up to {_at(second)}, " in line
        assert ("2 are stamped later" if second == 15 else "1 is stamped later") in line


@pytest.fixture
def ours(log_path: Path) -> Iterator[LogReader]:
    """Imported in the year 2001: a loss; keyframe 1 at second 10; a reject; keyframe 2 at second
    20; a loss stamped at second 1; keyframe 3 at second 30; a reject."""
    year_2001 = 10**9 * SECOND
    with LogWriter(log_path, clock=lambda: year_2001) as writer:
        writer.append("mapfold/loss", b"{}")
        writer.append(KEY, envelope(1), stamp_ns=10 * SECOND)
        writer.append("mapfold/rejected", b"{}")
        writer.append(KEY, envelope(2), stamp_ns=20 * SECOND)
        writer.append("mapfold/loss", b"{}", stamp_ns=1 * SECOND)
        writer.append(KEY, envelope(3), stamp_ns=30 * SECOND)
        writer.append("mapfold/rejected", b"{}")
    with LogReader(log_path) as reader:
        yield reader


@pytest.mark.parametrize(
    ("time", "count", "start"),
    [
        ("1970-01-01T00:00:01Z", 1, 1),
        ("1970-01-01T00:00:10Z", 3, 1),
        ("1970-01-01T00:00:15Z", 3, 3),
        ("1970-01-01T00:00:20Z", 5, 3),
        ("1970-01-01T00:00:30Z", 7, 5),
        ("1999-12-31T00:00:00Z", 7, 7),
        ("2001-09-09T01:46:40Z", 7, 7),
    ],
)
def test_the_stamps_of_system_events_are_ignored(
    ours: LogReader, time: str, count: int, start: int
) -> None:
    assert resolve(ours, time) == count
    assert resolve_start(ours, time) == start


def _at(second: int) -> str:
    return f"1970-01-01T00:00:{second:02d}Z"


@pytest.fixture
def rotten(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LogReader]:
    """Keyframes 0 to 8 at seconds 0 to 8, in chunks of three; 3, 4 and 5 cannot be read."""
    monkeypatch.setattr(_parts, "CHUNK_BYTES", 9000)
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        for second in range(9):
            payload = envelope(second, note="x" * 3000)
            writer.append(KEY, payload, stamp_ns=second * SECOND)
            if second % 3 == 2:
                writer.sync()
    with LogReader(log_path) as reader:
        (segment,) = reader.segments
        chunks = reader.open_segment(segment).chunks
        assert [chunk.first for chunk in chunks] == [0, 3, 6]
        flip(segment.path, chunks[1].position + chunks[1].length // 2)
        yield reader


@pytest.mark.parametrize(("second", "count"), [(0, 1), (1, 2), (2, 6), (4, 6), (6, 7), (20, 9)])
def test_a_range_up_to_a_time_includes_damage_only_inside_it(
    rotten: LogReader, second: int, count: int
) -> None:
    assert resolve(rotten, _at(second)) == count
    for text in ("run:1", "2", "end"):
        resolve(rotten, text)


def test_damage_stops_the_search_or_is_reported(rotten: LogReader) -> None:
    assert resolve_start(rotten, _at(2)) == 2
    for text in (_at(3), _at(7), "run:7"):
        with pytest.raises(LogDamaged, match="offsets 3 to 5 cannot be read"):
            resolve_start(rotten, text)
    met: list[Unreadable] = []
    for text, start in ((_at(3), 6), (_at(7), 7), (_at(20), 9), ("run:7", 7)):
        assert resolve_start(rotten, text, on_gap=met.append) == start
    assert resolve(rotten, "run:7", on_gap=met.append) == 8
    assert [(gap.first, gap.last) for gap in met] == [(3, 5)] * 5


def test_rot_at_the_end_of_the_growing_segment_is_reported(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer, LogReader(log_path) as reader:
        for second in range(9):
            writer.append(KEY, envelope(second), stamp_ns=second * SECOND)
            if second % 3 == 2:
                writer.sync()
        reader.refresh()
        (segment,) = reader.segments
        flip(segment.path, reader.open_segment(segment).chunks[1].position + 5)
        with LogReader(log_path) as rotten:
            assert rotten.next_offset == 3
            assert resolve(rotten, _at(1)) == 2
            for second in (2, 4, 20):
                with pytest.raises(LogDamaged, match="offsets 3 to 8 cannot be read"):
                    resolve(rotten, _at(second))
            with pytest.raises(LogDamaged, match="offsets 3 to 8 cannot be read"):
                resolve(rotten, "end")
            met: list[Unreadable] = []
            assert resolve(rotten, _at(4), on_gap=met.append) == 3
            assert resolve(rotten, "end", on_gap=met.append) == 3
            assert [(gap.first, gap.last) for gap in met] == [(3, 8)] * 2
        flip(segment.path, reader.open_segment(segment).chunks[1].position + 5)
