"""Points in a log mean what DESIGN section 8 says."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader, LogWriter
from eventsrc.log.whence import resolve, resolve_start
from tests.fixtures_log import KEY, envelope

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
        ("a:1", 1, 0),
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
def test_what_is_not_there_is_named(reader: LogReader, text: str) -> None:
    for ask in (resolve, resolve_start):
        with pytest.raises(MisuseError) as caught:
            ask(reader, text)
        assert text in str(caught.value)
