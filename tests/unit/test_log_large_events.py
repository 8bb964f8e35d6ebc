"""Events that are each larger than a chunk, a group and, with others, a segment."""

from pathlib import Path

import pytest
from mcap.reader import SeekingReader

from eventsrc.log import LogReader, LogWriter, recover_log, verify_log
from eventsrc.log.durable_files import GROUP_BYTES
from eventsrc.log.seal import CHUNK_BYTES
from tests.support.fixtures_log import KEY, envelope, flip, read_log

SIZE = 8_000_000
COUNT = 5


def _payload(number: int) -> bytes:
    """An envelope of eight megabytes that compresses well, so that this stays quick."""
    return envelope(number, note=f"{number:08d}" * (SIZE // 8))


@pytest.fixture
def log(log_path: Path) -> Path:
    """Small events around large ones, in two sealed segments."""
    with LogWriter(log_path, rotate_bytes=20_000_000) as writer:
        for number in range(COUNT):
            writer.append(KEY, envelope(100 + number), stamp_ns=100 + number)
            writer.append(KEY, _payload(number), stamp_ns=number)
            if number == 2:
                writer.sync()
                writer.commit_if_due()  # rotates
    return log_path


def test_large_events_are_read_back_one_chunk_at_a_time(log: Path) -> None:
    assert max(CHUNK_BYTES, GROUP_BYTES) < SIZE
    events = read_log(log)
    assert [event.offset for event in events] == list(range(2 * COUNT))
    for number in range(COUNT):
        assert events[2 * number].payload == envelope(100 + number)
        assert events[2 * number + 1].payload == _payload(number)
        (alone,) = read_log(log, 2 * number + 1, 2 * number + 2)
        assert alone == events[2 * number + 1]


def test_large_events_are_sealed_and_verified(log: Path) -> None:
    files = sorted(log.glob("*.mcap"))
    assert len(files) == 2
    assert not list(log.glob("*.active"))
    assert verify_log(log).findings == ()
    total = 0
    for file in files:
        with file.open("rb") as stream:
            reader = SeekingReader(stream, validate_crcs=True)
            total += sum(1 for _ in reader.iter_messages())
    assert total == 2 * COUNT


def test_a_flip_in_a_large_event_costs_that_event_and_its_neighbours_in_the_chunk(
    log: Path,
) -> None:
    with LogReader(log) as reader:
        segment = reader.open_segment(reader.segments[0])
        chunk = next(c for c in segment.chunks if c.first <= 1 < c.following)
        path = segment.path
    flip(path, chunk.position + chunk.length // 2)
    (recovered,) = recover_log(log).segments
    assert recovered.gaps == ((chunk.first, chunk.following - 1),)
    assert chunk.following - chunk.first <= 2
    kept = [event for event in read_log(log) if event.key == KEY]
    assert len(kept) == 2 * COUNT - (chunk.following - chunk.first)
