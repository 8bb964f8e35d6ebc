"""Keys and payloads whose bytes look like commit marks, chunks and messages: whatever is cut off or
lost of what was not synced, exactly the synced events come back and nothing is made up."""

import itertools
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log.channels import key_channel
from eventsrc.log.format import (
    HEAD_BYTES,
    MARK_SEED,
    file_head,
    head_metadata,
    mark_seed,
    read_head,
)
from tests.support.fixtures_log import BY_HAND, KEY, MEMORY_DISK, read_log
from tests.support.thorough import examples

SYNCED = 3
"""Commits that are complete before the one that is damaged."""


def forged_chunk(first: int, count: int) -> bytes:
    """A chunk as a writer makes it, with a right CRC, of the sequence numbers from ``first`` on."""
    body = _mcap.encode(key_channel(1, 0, "forged", 1)) + b"".join(
        _mcap.encode_message_head(1, first + n, 7, 7, 6) + b"forged" for n in range(count)
    )
    crc = zlib.crc32(body)
    return _mcap.encode_plain_chunk_head(len(body), crc, 7, 7) + body


def as_key(first: int, following: int, seed: int) -> str:
    """A key that holds a commit mark; keys are UTF-8, so not every mark will do."""
    for number in itertools.count(following):
        ascii_only = number & 0x7F7F7F7F7F7F7F7F
        try:
            return (b"k/\xc2" + _mcap.encode_mark(first, ascii_only, seed)).decode()
        except UnicodeDecodeError:
            continue
    raise AssertionError


numbers = st.one_of(st.integers(0, 12), st.integers(0, 2**40))


@st.composite
def forgeries(draw: st.DrawFn, seed: int) -> bytes:
    """Marks, chunks and both in a row, with rubbish before them."""
    parts = [draw(st.binary(max_size=9))]
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, 12))
        count = draw(st.integers(1, 3))
        mark = _mcap.encode_mark(first, first + draw(numbers), seed)
        whole = forged_chunk(first, count)
        whole += _mcap.encode_mark(first, first + count, seed)
        parts.append(draw(st.sampled_from([mark, whole, whole[:60], mark + whole, b"\x05\x00"])))
    return b"".join(parts)


class Growing:
    """A log of some synced commits of ordinary events and one more of hostile ones, as a killed
    writer leaves it; ``seed`` is what marks are forged with (the segment's own if None)."""

    def __init__(self, folder: Path, data: st.DataObject, seed: int | None) -> None:
        self.path = folder / "log"
        writer = LogWriter(self.path, fsync=BY_HAND)
        self.file = next(self.path.glob("*.active"))
        head = read_head(self.file, self.file.read_bytes()[:HEAD_BYTES], 0)[0]
        self.seed = mark_seed(head) if seed is None else seed
        for number in range(SYNCED):
            writer.append(KEY, b"ordinary %d" % number)
            writer.append(KEY, data.draw(forgeries(self.seed)))
            writer.sync()
        self.synced_bytes = self.file.stat().st_size
        self.synced = read_log(self.path)
        for _ in range(data.draw(st.integers(1, 3))):
            first = data.draw(st.integers(0, 12))
            key = as_key(first, first + data.draw(st.integers(1, 2**40)), self.seed)
            writer.append(key, data.draw(forgeries(self.seed)))
        writer.sync()
        self.written = read_log(self.path)
        writer._active.close()
        writer._lock.release()

    def damage(self, content: bytes) -> None:
        self.file.write_bytes(content)

    def check(self, *, recover: bool) -> None:
        """Read, start or recover, read again."""
        shown = read_log(self.path)
        assert shown == self.written[: len(shown)]
        assert len(shown) >= len(self.synced)
        assert not {f.kind for f in verify_log(self.path).findings} & {"gap", "crc"}
        if recover:
            assert not any(segment.gaps for segment in recover_log(self.path).segments)
        with LogWriter(self.path, fsync=ALWAYS) as writer:
            assert writer.next_offset >= len(shown)
            writer.append(KEY, b"later")
        events = read_log(self.path)
        assert events[:-1] == self.written[: len(events) - 1]
        assert len(events) > len(shown)
        assert events[-1].payload == b"later"


@pytest.fixture
def folder() -> Iterator[Path]:
    base = MEMORY_DISK if MEMORY_DISK.is_dir() else None
    with tempfile.TemporaryDirectory(dir=base) as name:
        yield Path(name)


QUICK = settings(max_examples=examples(150), deadline=None)


def in_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(dir=MEMORY_DISK if MEMORY_DISK.is_dir() else None)


@QUICK
@given(data=st.data())
def test_after_a_kill_at_any_byte_what_was_synced_is_there(data: st.DataObject) -> None:
    """Even with the seed known, nothing can be forged."""
    with in_folder() as name:
        log = Growing(Path(name), data, None)
        content = log.file.read_bytes()
        log.damage(content[: data.draw(st.integers(log.synced_bytes, len(content)))])
        log.check(recover=data.draw(st.booleans()))


@QUICK
@given(data=st.data())
def test_after_a_power_cut_that_took_any_part_of_the_last_write(data: st.DataObject) -> None:
    """Unsynced bytes may be zeros from anywhere to anywhere, and so may the mark before them."""
    with in_folder() as name:
        log = Growing(Path(name), data, 0)
        content = bytearray(log.file.read_bytes())
        unsynced = st.integers(log.synced_bytes - _mcap.MARK_BYTES, len(content))
        del content[-_mcap.MARK_BYTES :]  # not written before the sync that did not come
        for _ in range(data.draw(st.integers(1, 3))):
            start, end = sorted((data.draw(unsynced), data.draw(unsynced)))
            content[start:end] = bytes(len(content[start:end]))
        log.damage(bytes(content))
        with LogReader(log.path) as reader:
            shown = list(reader.read())
        assert shown == log.written[: len(shown)]
        recover_log(log.path)
        events = read_log(log.path)
        assert events == log.written[: len(events)]
        assert len(events) >= len(log.synced)


@QUICK
@given(data=st.data())
def test_rot_anywhere_makes_nothing_up(data: st.DataObject) -> None:
    with in_folder() as name:
        log = Growing(Path(name), data, 0)
        content = bytearray(log.file.read_bytes())
        start = data.draw(st.integers(0, len(content) - 1))
        length = data.draw(st.integers(1, 80))
        content[start : start + length] = bytes(len(content[start : start + length]))
        log.damage(bytes(content))
        recover_log(log.path)
        events = read_log(log.path)
        assert len(events) <= len(log.written)
        for event, was in zip(events, log.written, strict=False):
            assert event == was or (event.key == LOSS_KEY and event.offset == was.offset)


def test_a_growing_segment_whose_header_is_damaged_is_not_taken_for_another_programs(
    folder: Path,
) -> None:
    path = folder / "log"
    writer = LogWriter(path, fsync=BY_HAND)
    for payload in (b"first", b"second"):
        writer.append(KEY, payload)
        writer.sync()
    file = next(path.glob("*.active"))
    writer._active.close()
    writer._lock.release()
    content = bytearray(file.read_bytes())
    content[10:40] = bytes(30)
    file.write_bytes(content)
    recover_log(path)
    assert [event.payload for event in read_log(path)] == [b"first", b"second"]


@pytest.mark.parametrize("torn", [10, 100, 140])
def test_a_forged_mark_in_a_key_does_not_stop_readers(folder: Path, torn: int) -> None:
    path = folder / "log"
    writer = LogWriter(path, fsync=BY_HAND)
    writer.append(KEY, b"first")
    writer.sync()
    file = next(path.glob("*.active"))
    size = file.stat().st_size
    writer.append(as_key(1, 5_000_000, 0), b"x" * 200)
    writer.sync()
    writer._active.close()
    writer._lock.release()
    content = file.read_bytes()
    file.write_bytes(content[: -_mcap.MARK_BYTES - torn])
    assert file.stat().st_size > size
    assert [e.payload for e in read_log(path)] == [b"first"]
    with LogWriter(path) as again:
        assert again.next_offset == 1
    (event,) = read_log(path)
    assert event.payload == b"first"


@pytest.mark.parametrize("seed", ["", "none", "-1", "123456789"])
def test_a_head_with_a_seed_that_is_no_number_is_damaged(folder: Path, seed: str) -> None:
    file = folder / f"{0:020d}.mcap.active"
    file.write_bytes(file_head(head_metadata("log", 0, {MARK_SEED: seed})))
    with pytest.raises(LogDamaged, match="mark seed"):
        read_log(folder)
    recover_log(folder)
    assert read_log(folder) == []


def test_a_head_without_a_seed_is_of_no_released_version(folder: Path) -> None:
    path = folder / f"{0:020d}.mcap.active"
    path.write_bytes(file_head(head_metadata("log", 0)))
    for use in (read_log, LogWriter):
        with pytest.raises(NotALog, match=r"never released.*mapfold import LOG"):
            use(folder)
    with pytest.raises(LogDamaged, match=r"never released.*nothing was changed"):
        recover_log(folder)
    assert path.exists()
