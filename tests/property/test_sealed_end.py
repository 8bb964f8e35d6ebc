"""A sealed segment that was cut or deleted: what is missing is a loss, in numbers."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, Event, Finding, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import seal as _seal
from eventsrc.log.format import SEALED_END
from eventsrc.log.sealed_end import sealed_end
from eventsrc.log.sealed_segment import SealedFile
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import envelope, read_log, write_log
from tests.support.thorough import stride

EACH = 4


@pytest.fixture(params=[1, 3], ids=["only segment", "last of three"])
def log(quick_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of so many segments, each of four events in chunks of one."""
    monkeypatch.setattr(_seal, "CHUNK_BYTES", 1)
    path = quick_path / "log"
    payloads = [envelope(number) for number in range(EACH * request.param)]
    write_log(path, payloads, fsync=ALWAYS, rotate_events=EACH)
    return path


def last_segment(log: Path) -> Path:
    return max(log.glob("*.mcap"))


def damage(log: Path) -> list[Finding]:
    """The findings of `log verify`, but for stamps of events that a test made up."""
    return [f for f in verify_log(log).findings if f.kind != "time"]


def check_lost(log: Path, before: list[Event]) -> int:
    """All commands say that events are missing; recovery marks just these. How many."""
    gaps = [f for f in verify_log(log).findings if f.kind == "gap"]
    lost = {n for f in gaps for n in range(f.first_offset or 0, (f.last_offset or 0) + 1)}
    for use in (read_log, LogWriter, log_info):
        with pytest.raises(LogDamaged, match="mapfold log recover"):
            use(log)
    report = recover_log(log)
    assert sum(s.lost_events for s in report.segments) == len(lost)
    assert report.findings
    after = read_log(log)
    assert len(after) == len(before)
    assert {e.offset for e in after if e.key == LOSS_KEY} == lost
    assert all(e == before[e.offset] for e in after if e.offset not in lost)
    assert {f.kind for f in verify_log(log).findings} == {"loss"}
    assert (recover_log(log).segments, log_info(log).lost) == ((), len(lost))
    with LogWriter(log) as writer:
        assert writer.next_offset == len(before)
    return len(lost)


@pytest.mark.parametrize("noted", [True, False])
def test_a_cut_segment_lacks_events_in_numbers(log: Path, quick_path: Path, noted: bool) -> None:
    before, whole = read_log(log), last_segment(log).read_bytes()
    if not noted:  # a copy of the segments alone
        (log / SEALED_END).unlink()
    least = 0 if noted else 1_000  # the head names the end
    lost = []
    for length in range(least, len(whole) - 1, 97 * stride(5)):
        copy = quick_path / f"cut at {length}"
        shutil.copytree(log, copy)
        last_segment(copy).write_bytes(whole[:length])
        if not any(f.kind == "gap" for f in verify_log(copy).findings):
            recover_log(copy)  # only the index is cut
            assert read_log(copy) == before
            continue
        lost.append(check_lost(copy, before))
    assert lost
    assert lost == sorted(lost, reverse=True)
    assert lost[0] == (EACH if noted else lost[0])


def test_a_cut_segment_of_a_damaged_head_lacks_at_least_one(log: Path) -> None:
    with LogWriter(log) as writer:
        base = Offset(writer.next_offset)
        for number in range(EACH):
            writer.append("tb/detections", envelope(number, "more"))
    (log / SEALED_END).unlink()
    before = read_log(log)
    assert damage(log) == []
    segment = last_segment(log)
    os.truncate(segment, SealedFile(segment, base).chunks[2].position + 20)
    content = segment.read_bytes()
    segment.write_bytes(content.replace(b"previous", b"previoux", 1))
    with pytest.raises(LogDamaged, match="mapfold log recover"):
        read_log(log)
    report = recover_log(log)
    assert report.findings
    assert report.segments[0].lost_events == 1
    after = read_log(log)
    assert len(after) == base + 3
    assert after[:-1] == before[: len(after) - 1]
    assert after[-1].key == LOSS_KEY


def test_deleted_segments_are_lost(log: Path) -> None:
    before = read_log(log)
    last_segment(log).unlink()
    assert check_lost(log, before) == EACH


def test_all_but_the_first_deleted(log: Path) -> None:
    before = read_log(log)
    for segment in sorted(log.glob("*.mcap"))[1:]:
        segment.unlink()
    if len(before) > EACH:
        assert check_lost(log, before) == len(before) - EACH


def test_a_tail_stops_where_segments_are_missing(log: Path) -> None:
    with LogReader(log) as reader:
        write = LogWriter(log)
        write.append("tb/detections", envelope(99))
        write.close()
        last_segment(log).unlink()
        reader.refresh()
        with pytest.raises(LogDamaged, match="were sealed and are not there"):
            reader.check_end()


def as_garbage(path: Path) -> None:
    path.write_bytes(b"\xff[")


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def as_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def as_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def as_another_number(path: Path) -> None:
    path.write_text(path.read_text().replace('"following": "', '"following": "9'))


def as_nested(path: Path) -> None:
    path.write_text("[" * 4_000)


def as_that_of_another_log(path: Path) -> None:
    other = path.parent.parent / "other"
    write_log(other, [b"{}"] * 100)
    shutil.copy(other / SEALED_END, path)


@pytest.mark.parametrize(
    "spoil",
    [as_garbage, as_folder, as_fifo, as_link, as_another_number, as_nested, as_that_of_another_log],
)
def test_a_spoilt_note_is_reported_and_harms_nothing(
    log: Path, spoil: Callable[[Path], None]
) -> None:
    before = read_log(log)
    spoil(log / SEALED_END)
    assert read_log(log) == before
    (finding,) = damage(log)
    assert (finding.segment, finding.kind in ("crc", "log_id")) == (SEALED_END, True)
    assert not recover_log(log).segments
    assert damage(log) == []
    assert read_log(log) == before


@pytest.mark.parametrize("content", [None, 0])
def test_a_note_that_is_older_or_missing_is_written_at_the_next_sealing(
    log: Path, content: int | None
) -> None:
    old = (log / SEALED_END).read_bytes()
    with LogWriter(log) as writer:
        writer.append("tb/detections", envelope(99))
    (log / SEALED_END).unlink()
    if content is not None:
        (log / SEALED_END).write_bytes(old)
    before = read_log(log)
    assert damage(log) == []
    with LogWriter(log) as writer:
        writer.append("tb/detections", envelope(100))
    assert len(read_log(log)) == len(before) + 1
    end = sealed_end(log)
    assert end is not None
    assert end.following == len(before) + 1


def test_recovery_writes_a_missing_note(log: Path) -> None:
    whole = (log / SEALED_END).read_bytes()
    (log / SEALED_END).unlink()
    assert not recover_log(log).findings
    assert (log / SEALED_END).read_bytes() == whole
    assert set(json.loads(whole)) == {"log_id", "base", "following", "crc32"}
