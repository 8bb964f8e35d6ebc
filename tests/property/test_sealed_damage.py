"""A sealed segment with any one byte changed: verify reports it or no event has changed, reading
invents no event, and recovery keeps every good chunk at its offsets."""

import contextlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY, Loss
from eventsrc.log import ALWAYS, Event, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log import seal as _parts
from eventsrc.log.format import SEALED_END
from eventsrc.log.sealed_segment import SealedFile
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import (
    BY_HAND,
    KEY,
    envelope,
    flip,
    read_log,
    read_with_gaps,
    write_log,
)
from tests.support.thorough import stride

MEMORY_DISK = Path("/dev/shm")
EVENTS = 6


@pytest.fixture
def sealed(quick_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[Event]]:
    """A sealed segment of one event a chunk, and its events."""
    monkeypatch.setattr(_parts, "CHUNK_BYTES", 1)
    log = quick_path / "log"
    with LogWriter(log, fsync=BY_HAND) as writer:
        for index in range(EVENTS):
            writer.append(KEY, envelope(index), stamp_ns=index, logged_ns=9)
            if index % 2:
                writer.sync()
    return next(log.glob("*.mcap")), read_log(log)


def test_an_undamaged_segment_has_no_findings(sealed: tuple[Path, list[Event]]) -> None:
    verified = verify_log(sealed[0].parent)
    assert verified.findings == ()
    assert (verified.events, verified.segments) == (EVENTS, 1)


def test_every_flip_is_found_and_never_read(sealed: tuple[Path, list[Event]]) -> None:
    file, events = sealed
    data = bytearray(file.read_bytes())
    for at in range(0, len(data), stride(29)):
        data[at] ^= 0x20
        file.write_bytes(data)
        findings = verify_log(file.parent).findings
        assert findings, f"byte {at} of {len(data)} changed without a finding"
        named = {
            offset
            for f in findings
            if f.first_offset is not None and f.last_offset is not None
            for offset in range(f.first_offset, f.last_offset + 1)
        }
        with contextlib.suppress(LogError):
            shown, gaps = read_with_gaps(file.parent)
            assert all(event == events[event.offset] for event in shown)
            assert {e.offset for e in shown} | gaps == set(range(EVENTS))
            assert gaps <= named
        data[at] ^= 0x20


def test_recovery_keeps_every_good_chunk_at_its_offsets(sealed: tuple[Path, list[Event]]) -> None:
    file, events = sealed
    log = file.parent
    original = file.read_bytes()
    for at in range(0, len(original), 3 * stride(67)):
        damaged = bytearray(original)
        damaged[at] ^= 0x20
        file.write_bytes(damaged)
        report = recover_log(log)
        (segment,) = report.segments
        assert segment.kept_events + segment.lost_events == EVENTS
        assert segment.lost_events in (0, 1)
        assert segment.kept_copy is not None
        assert (log / segment.kept_copy).read_bytes() == bytes(damaged)
        lost = {o for first, last in segment.gaps for o in range(first, last + 1)}
        for event, was in zip(read_log(log), events, strict=True):
            if event.offset not in lost:
                assert event == was
                continue
            loss = Loss.model_validate_json(event.payload)
            assert event.key == LOSS_KEY
            assert (loss.first, loss.last, loss.cause) == (event.offset, event.offset, "rot")
        assert {f.kind for f in verify_log(log).findings} == ({"loss"} if lost else set())
        assert log_info(log).lost == len(lost)
        assert recover_log(log).segments == ()
        (log / segment.kept_copy).unlink()


def test_a_sealed_segment_cut_at_any_byte_is_reported_and_recovered(
    sealed: tuple[Path, list[Event]],
) -> None:
    segment, written = sealed
    log, whole = segment.parent, segment.read_bytes()
    head = SealedFile(segment, FIRST_OFFSET).head_bytes
    for length in range(0, len(whole), stride(29)):
        segment.write_bytes(whole[:length])
        assert {f.kind for f in verify_log(log).findings} & {"crc", "gap"}, length
        with contextlib.suppress(LogError):
            events, _ = read_with_gaps(log)
            assert events == written[: len(events)]
    for length in (0, *range(len(whole) - 1, len(_mcap.MAGIC), -len(whole) // (40 // stride(8)))):
        segment.write_bytes(whole[:length])
        recover_log(log)
        read = read_log(log)
        good = [event for event in read if event.key != LOSS_KEY]
        assert good == written[: len(good)]
        assert len(read) == (EVENTS if length == 0 or length >= head else 1)
        for left in (*log.glob("*.mcap*"), log / SEALED_END):
            left.unlink()


def test_a_missing_segment_becomes_losses(quick_path: Path) -> None:
    log = quick_path / "log"
    with LogWriter(log, rotate_events=2, fsync=BY_HAND) as writer:
        for index in range(EVENTS):
            writer.append(KEY, envelope(index))
            if index % 2:
                writer.sync()
                writer.commit_if_due()
    (log / "00000000000000000002.mcap").unlink()
    assert [f.kind for f in verify_log(log).findings] == ["gap", "chain"]
    with pytest.raises(LogError, match="offsets 2 to 3"):
        read_log(log)
    report = recover_log(log)
    assert [s.gaps for s in report.segments] == [((2, 3),)]
    assert [e.key == LOSS_KEY for e in read_log(log)] == [False, False, True, True, False, False]
    assert [f.kind for f in verify_log(log).findings] == ["loss"]
    with LogWriter(log) as writer:
        assert writer.next_offset == EVENTS


def test_a_missing_first_segment_is_reported(quick_path: Path) -> None:
    log = quick_path / "log"
    with LogWriter(log, rotate_events=2, fsync=BY_HAND) as writer:
        for index in range(4):
            writer.append(KEY, envelope(index))
            if index % 2:
                writer.sync()
                writer.commit_if_due()
    (log / "00000000000000000000.mcap").unlink()
    with pytest.raises(LogError, match="offsets 0 to 1 cannot be read: missing before"):
        read_log(log)
    with pytest.raises(LogError, match="offsets 1 to 1 cannot be read"):
        read_log(log, 1)
    with pytest.raises(LogError, match="offsets 0 to 0 cannot be read"):
        read_log(log, 0, 1)
    shown, named = read_with_gaps(log)
    assert ([event.offset for event in shown], named) == ([2, 3], {0, 1})
    assert [event.offset for event in read_log(log, 2)] == [2, 3]


def test_recovering_a_log_without_events_leaves_one(quick_path: Path) -> None:
    log = quick_path / "log"
    LogWriter(log).close()
    with LogReader(log) as reader:
        log_id = reader.log_id
    assert recover_log(log).segments == ()
    (active,) = log.glob("*.active")
    active.write_bytes(active.read_bytes() + b"torn")
    (segment,) = recover_log(log).segments
    assert (segment.kept_events, segment.lost_bytes, segment.kept_copy) == (0, 4, None)
    assert recover_log(log).segments == ()
    assert read_log(log) == []
    with LogWriter(log) as writer:
        assert (writer.log_id, writer.next_offset) == (log_id, 0)


def test_recovering_a_log_without_readable_events_leaves_losses(
    sealed: tuple[Path, list[Event]],
) -> None:
    file, _ = sealed
    with LogReader(file.parent) as reader:
        log_id, start = reader.log_id, reader.open_segment(reader.segments[0]).head_bytes
    data = file.read_bytes()
    file.write_bytes(data[:start] + bytes(len(data) - start))
    (segment,) = recover_log(file.parent).segments
    assert segment.kept_copy == f"{file.name}.damaged"
    assert recover_log(file.parent).segments == ()
    assert [event.key for event in read_log(file.parent)] == [LOSS_KEY] * EVENTS
    with LogWriter(file.parent) as writer:
        assert (writer.log_id, writer.next_offset) == (log_id, EVENTS)


def test_losses_have_the_times_of_their_neighbours(quick_path: Path) -> None:
    log = quick_path / "log"
    with LogWriter(log, rotate_events=2, fsync=BY_HAND) as writer:
        for index in range(8):
            writer.append(KEY, envelope(index), stamp_ns=1000 + index, logged_ns=2000 + index)
            if index % 2:
                writer.sync()
                writer.commit_if_due()
    for base in (0, 4):
        (log / f"{base:020d}.mcap").unlink()
    recover_log(log)
    near = [2, 2, 2, 3, 3, 3, 6, 7]
    assert [(e.stamp_ns, e.logged_ns) for e in read_log(log)] == [
        (1000 + n, 2000 + n) for n in near
    ]
    info = log_info(log)
    assert (info.first_logged_ns, info.first_stamp_ns, info.last_stamp_ns) == (2002, 1002, 1007)


def test_a_loss_in_a_segment_has_the_times_of_the_event_before_it(
    sealed: tuple[Path, list[Event]],
) -> None:
    with LogReader(sealed[0].parent) as reader:
        chunks = reader.open_segment(reader.segments[0]).chunks
    for number in (0, 3):
        flip(sealed[0], chunks[number].position + chunks[number].length // 2)
    recover_log(sealed[0].parent)
    assert [e.stamp_ns for e in read_log(sealed[0].parent)] == [1, 1, 2, 2, 4, 5]


@pytest.mark.parametrize("rotate_events", [2, 1000])
@pytest.mark.parametrize("still_open", [True, False])
def test_system_events_do_not_change_the_bounds_of_stamps(
    quick_path: Path, rotate_events: int, still_open: bool
) -> None:
    log = quick_path / "log"
    writer = LogWriter(log, rotate_events=rotate_events, fsync=BY_HAND)
    keys = [LOSS_KEY, KEY, REJECTED_KEY, KEY, KEY, KEY, LOSS_KEY, LOSS_KEY]
    for stamp_ns, key in zip([1, 20, 90, 40, 30, 50, 10, 80], keys, strict=True):
        writer.append(key, envelope(stamp_ns), stamp_ns=stamp_ns)
        writer.sync()
        writer.commit_if_due()
    if still_open:
        assert (log_info(log).first_stamp_ns, log_info(log).last_stamp_ns) == (20, 50)
    writer.close()
    assert (log_info(log).first_stamp_ns, log_info(log).last_stamp_ns) == (20, 50)


def test_a_log_of_system_events_only_has_no_stamps(quick_path: Path) -> None:
    with LogWriter(quick_path / "log") as writer:
        writer.append(LOSS_KEY, b"{}")
    info = log_info(quick_path / "log")
    assert (info.first_stamp_ns, info.last_stamp_ns) == (None, None)
    assert info.first_logged_ns is not None


def test_the_hash_chain_detects_a_replaced_segment(quick_path: Path) -> None:
    for name in ("a", "b"):
        with LogWriter(quick_path / name, rotate_events=1, fsync=BY_HAND) as writer:
            for index in range(3):
                writer.append(KEY, envelope(index, name), logged_ns=index)
                writer.sync()
                writer.commit_if_due()
    middle = "00000000000000000001.mcap"
    shutil.copy(quick_path / "b" / middle, quick_path / "a" / middle)
    kinds = [f.kind for f in verify_log(quick_path / "a").findings]
    assert kinds == ["log_id", "gap"]


@pytest.mark.parametrize("which", [0, 2, 4])
def test_a_segment_of_another_log_is_not_read(quick_path: Path, which: int) -> None:
    for name in "ab":
        payloads = [f"{name}{number}".encode() for number in range(6)]
        write_log(quick_path / name, payloads, fsync=ALWAYS, rotate_events=2)
    log, foreign = quick_path / "a", f"{which:020d}.mcap"
    before = {p.name for p in log.iterdir()}
    shutil.copy(quick_path / "b" / foreign, log / foreign)
    events, named = read_with_gaps(log)
    wrong = {which, which + 1}
    if which == 4:  # the last one says whose log it is
        assert named == set(range(4))
    else:
        assert named == wrong
        assert {e.payload[:1] for e in events} == {b"a"}
    for use in (read_log, LogWriter):
        with pytest.raises(LogDamaged, match=r"belongs to log .* put the right file in place"):
            use(log)
    assert {p.name for p in log.iterdir()} == before
    (moved,) = recover_log(log).moved
    assert moved.now == f"{foreign}.foreign-{verify_log(quick_path / 'b').log_id}"
    assert (log / moved.now).read_bytes() == (quick_path / "b" / foreign).read_bytes()
    kept = [number for number in range(6) if number not in wrong]
    assert [e.payload for e in read_log(log) if e.key != LOSS_KEY] == [b"a%d" % n for n in kept]
    assert [e.offset for e in read_log(log)] == list(range(6))


def test_verify_reports_findings_in_events(quick_path: Path) -> None:
    log = quick_path / "log"
    loss = {"publisher": "r", "first": 2, "last": 4, "count": 3, "cause": "keyframe_gap"}
    with LogWriter(log) as writer:
        writer.append(KEY, envelope(1, "r"), stamp_ns=5, logged_ns=100)
        writer.append(KEY, b'{"run_id": 3}', stamp_ns=6, logged_ns=101)
        writer.append(KEY, envelope(5, "r"), stamp_ns=4, logged_ns=99)
        writer.append(KEY, envelope(1, "r"), stamp_ns=5, logged_ns=102)
        writer.append(LOSS_KEY, json.dumps(loss).encode(), logged_ns=103)
        writer.append(LOSS_KEY, b"{}", logged_ns=104)
    found = [(f.kind, f.first_offset, f.count) for f in verify_log(log).findings]
    assert found == [
        ("schema", 1, 1),
        ("time", 2, 1),
        ("time", 2, 1),
        ("duplicate", 3, 1),
        ("loss", 4, 3),
        ("schema", 5, 1),
    ]
    assert log_info(log).lost == 3


def _gap(first: int, last: int, run_id: str = "r") -> bytes:
    count = last - first + 1
    loss = Loss(publisher=run_id, first=first, last=last, count=count, cause="keyframe_gap")
    return loss.model_dump_json().encode()


def test_a_late_keyframe_closes_its_gap(quick_path: Path) -> None:
    log = quick_path / "log"
    with LogWriter(log) as writer:
        writer.append(LOSS_KEY, _gap(2, 4))
        writer.append(KEY, envelope(3, "r"), stamp_ns=3)
        writer.append(KEY, envelope(2, "other"))
    assert log_info(log).lost == 2
    (finding,) = verify_log(log).findings
    assert (finding.kind, finding.count, finding.first_offset) == ("loss", 2, 0)
    with LogWriter(log) as writer:
        writer.append(KEY, envelope(4, "r"), stamp_ns=4)
        writer.append(KEY, envelope(2, "r"), stamp_ns=2)
    assert log_info(log).lost == 0
    assert verify_log(log).findings == ()


def test_a_gap_is_reported_with_the_offsets_of_its_open_reports(quick_path: Path) -> None:
    log = quick_path / "log"
    with LogWriter(log) as writer:
        for keyframe_id in (1, 4, 6, 10):
            writer.append(KEY, envelope(keyframe_id, "r"), stamp_ns=keyframe_id)
        for first, last in ((2, 3), (5, 5), (7, 9)):
            writer.append(LOSS_KEY, _gap(first, last))
        nonsense = _gap(5, 5).replace(b'"first":5', b'"first":99')
        writer.append(LOSS_KEY, nonsense)
        for keyframe_id in (8, 3, 2):
            writer.append(KEY, envelope(keyframe_id, "r"), stamp_ns=keyframe_id)
    findings = verify_log(log).findings
    told = [(f.kind, f.first_offset, f.last_offset, f.count) for f in findings]
    assert told == [("loss", 5, 7, 4)]
    assert "missing keyframes of run r (4, first at offset 5)" in findings[0].message
    assert log_info(log).lost == 4


@pytest.mark.parametrize(
    ("cause", "message"),
    [
        ("queue_full", "messages on key r lost because the queue was full (2, first at offset 0)"),
        ("too_large", "messages on key r lost because they were too large (2, first at offset 0)"),
        ("transport_miss", "messages of publisher r that were not received (2, first at offset 0)"),
        ("rot", "recorded events lost to damage (2, first at offset 0)"),
    ],
)
def test_a_loss_is_described_by_its_cause(quick_path: Path, cause: Any, message: str) -> None:
    log = quick_path / "log"
    with LogWriter(log) as writer:
        writer.append(
            LOSS_KEY, Loss(publisher="r", count=2, cause=cause).model_dump_json().encode()
        )
    (finding,) = verify_log(log).findings
    assert (finding.kind, finding.message) == ("loss", message)


DAY = 24 * 3600 * 10**9


@pytest.mark.parametrize(
    ("keyframes", "odd"),
    [
        ([(1, 10), (2, 20), (6, 60), (4, 40), (3, 30), (5, 50)], []),
        ([(3, 30), (2, 20), (1, 10)], []),
        ([(1, 10), (2, 10), (3, DAY + 10)], []),
        ([(1, 10), (2, 20), (3, 19), (4, 21)], [(2, 2, 1)]),
        ([(1, 10), (4, 40), (3, 45), (2, 20), (5, 50)], [(1, 1, 1)]),
        ([(1, 9), (2, 8), (3, 7)], [(1, 2, 2)]),
        ([(1, 10), (2, 20), (3, 9000 * DAY), (4, 9000 * DAY + 10)], [(2, 2, 1)]),
        ([(2, 20), (3, 9000 * DAY), (1, 10), (4, 5)], [(1, 1, 1), (3, 3, 1)]),
    ],
    ids=["late", "reversed", "a day", "back", "late and back", "backwards", "set", "set twice"],
)
def test_stamps_are_compared_in_the_order_of_keyframe_ids(
    quick_path: Path, keyframes: list[tuple[int, int]], odd: list[tuple[int, int, int]]
) -> None:
    with LogWriter(quick_path / "log") as writer:
        for keyframe_id, stamp_ns in keyframes:
            writer.append(KEY, envelope(keyframe_id), stamp_ns=stamp_ns)
    findings = verify_log(quick_path / "log").findings
    assert {f.kind for f in findings} <= {"time"}
    assert [(f.first_offset, f.last_offset, f.count) for f in findings] == odd
