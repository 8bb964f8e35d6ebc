"""Under --fsync never a power cut may take what stands before something it leaves: a start then
refuses and says what to do, and doing that keeps the rest."""

from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import LogReader, LogWriter, recover_log
from eventsrc.log.durable_files import FsyncPolicy
from eventsrc.log.mcap_records import MARK_BYTES
from tests.support.fixtures_log import KEY, read_log

NEVER_ONE_BY_ONE = FsyncPolicy(interval_ns=0, max_events=1, syncs=False)
PAGE = bytes(4096)


def _power_cut(log: Path, rotate_events: int) -> Path:
    """A log of three events as a killed writer leaves it, nothing sealed; its first segment."""
    writer = LogWriter(log, fsync=NEVER_ONE_BY_ONE, rotate_events=rotate_events)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    for letter in (b"a", b"b", b"c"):
        writer.append(KEY, letter * 9000)
    writer._active.close()
    writer._lock.release()
    return min(log.glob("*.active"))


def _lose_the_second_chunk(file: Path) -> None:
    with LogReader(file.parent) as reader:
        at = reader.open_segment(reader.segments[0]).chunks[1].position
    data = bytearray(file.read_bytes())
    data[at : at + len(PAGE)] = PAGE
    file.write_bytes(data)


def _lose_the_end(file: Path) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: -9000 - MARK_BYTES])


@pytest.mark.parametrize(
    ("rotate_events", "lose"), [(1000, _lose_the_second_chunk), (2, _lose_the_end)]
)
def test_a_segment_missing_in_the_middle_is_recovered_around(
    log_path: Path, rotate_events: int, lose: Callable[[Path], None]
) -> None:
    lose(_power_cut(log_path, rotate_events))
    with pytest.raises(LogDamaged, match="offsets 1 to 1") as caught:
        LogWriter(log_path)
    assert f"run `mapfold log recover {log_path}` to keep the rest" in str(caught.value)
    assert recover_log(log_path).segments[0].gaps == ((1, 1),)
    with LogWriter(log_path) as writer:
        assert writer.append(KEY, b"d") == 3
    events = read_log(log_path)
    assert [event.key for event in events] == [KEY, LOSS_KEY, KEY, KEY]
    assert [event.payload[:1] for event in events if event.key == KEY] == [b"a", b"c", b"d"]
