"""Failed seals are reported at once, lose nothing, and are tried again."""

import errno
import os
import random
import zlib
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log, verify_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log import seal as _seal
from eventsrc.log import sealer as _sealer
from eventsrc.log.format import ACTIVE, HEAD_BYTES, SEALED, read_head, segment_path
from eventsrc.log.sealer import Sealer
from tests.support.fixtures_log import KEY, flip, read_log


class Disk:
    """A disk that refuses sealed segments while it is full."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full = True
        real = _sealer.seal

        def seal(*args: object) -> str:
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(*args)  # type: ignore[arg-type]

        monkeypatch.setattr(_sealer, "seal", seal)


def segments(path: Path, count: int) -> Sealer:
    """Finished segments of one event each, and a sealer for them."""
    writer = LogWriter(path, fsync=ALWAYS, rotate_events=1)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    for number in range(count):
        writer.append(KEY, b"%d" % number)
    writer.close()
    return Sealer(path, writer.log_id, "")


def test_sealing_is_tried_again_after_a_full_disk(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sealer = segments(log_path, 3)
    disk = Disk(monkeypatch)
    sealer.submit(0, 1)
    sealer.submit(1, 2)
    sealer.finish()
    assert sealer.waiting == 2
    assert sealer.error is not None
    assert "No space left on device; its events are safe" in str(sealer.error)
    assert len(read_log(log_path)) == 3

    disk.full = False
    sealer = Sealer(log_path, LogReader(log_path).log_id, "")
    for base in range(3):
        sealer.submit(base, base + 1)
    sealer.finish()
    assert (sealer.waiting, sealer.error) == (0, None)
    assert not list(log_path.glob("*.active"))
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}


def test_segments_are_sealed_in_order(log_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(monkeypatch)
    with LogWriter(log_path, fsync=ALWAYS, rotate_events=1) as writer:
        writer.append(KEY, b"0")
        writer.append(KEY, b"1")
        assert writer.sealing.waiting > 0
        disk.full = False
    assert writer.sealing == (0, None)
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}  # the chain holds
    assert [e.payload for e in read_log(log_path)] == [b"0", b"1"]


def test_sealing_is_tried_again_after_a_failed_folder_sync(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sealer = segments(log_path, 2)
    real = _sealer.sync_directory
    failures = [OSError(errno.EIO, os.strerror(errno.EIO))]

    def sync_directory(path: Path) -> None:
        if failures:
            raise failures.pop()
        real(path)

    monkeypatch.setattr(_sealer, "sync_directory", sync_directory)
    sealer.submit(0, 1)
    sealer.submit(1, 2)
    sealer.finish()
    assert (sealer.waiting, sealer.error) == (0, None)
    assert {f.kind for f in verify_log(log_path).findings} == {"schema"}


def test_an_inconsistent_segment_is_reported_and_kept(log_path: Path) -> None:
    """Its CRC is right; only parsing it finds the error."""
    sealer = segments(log_path, 2)
    sealer = Sealer(log_path, LogReader(log_path).log_id, "")
    active = segment_path(log_path, 0, ACTIVE)
    active.write_bytes(with_a_cut_message(active.read_bytes()))
    sealer.submit(0, 1)
    sealer.submit(1, 2)
    sealer.finish()
    assert sealer.waiting == 2
    with pytest.raises(LogError, match=r"does not fit its chunk; run `mapfold log recover"):
        raise sealer.error or AssertionError("nothing said")
    assert {p.name for p in log_path.glob("*.mcap*")} == {
        segment_path(log_path, base, ACTIVE).name for base in (0, 1)
    }
    assert not segment_path(log_path, 0, SEALED).exists()


@pytest.mark.parametrize("at", [3, -10], ids=["chunk head", "commit mark"])
def test_events_behind_a_damaged_frame_are_not_dropped_by_sealing(log_path: Path, at: int) -> None:
    """Readers see nothing behind it, so a sealed segment of what they see would be all there is."""
    writer = LogWriter(log_path, fsync=ALWAYS)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    active = segment_path(log_path, 0, ACTIVE)
    ends = []
    for number in range(4):
        writer.append(KEY, b"%d" % number)
        ends.append(active.stat().st_size)
    writer.close()
    flip(active, ends[0] + at if at > 0 else ends[1] + at)
    sealer = Sealer(log_path, writer.log_id, "")
    sealer.submit(0, 4)
    sealer.finish()
    with pytest.raises(LogError, match=r"offsets 1 to 3 were recorded .* log recover"):
        raise sealer.error or AssertionError("nothing said")
    recover_log(log_path)
    kept = [e.payload for e in read_log(log_path) if e.key == KEY]
    assert kept == ([b"0", b"2", b"3"] if at > 0 else [b"0", b"1", b"2", b"3"])


def test_a_segment_deleted_before_it_was_sealed_is_reported(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=ALWAYS)
    writer.append(KEY, b"0")
    segment_path(log_path, 0, ACTIVE).unlink()
    with pytest.raises(LogError, match=r"was deleted before it was sealed: offsets 0 to 0 are"):
        writer.close()


def with_a_cut_message(data: bytes) -> bytes:
    """The last byte of the message goes, and every length and checksum around it is made right."""
    at = read_head(Path("a segment"), data[:HEAD_BYTES], 0)[1]
    head = _mcap.decode_chunk_head(data[at:])
    body = _mcap.decode_chunk(data[at : at + head.length])[:-1]
    made = _mcap.encode_plain_chunk_head(len(body), zlib.crc32(body), 0, 0)
    return data[:at] + made + body + data[at + head.length :]


def test_the_advice_for_a_full_disk_is_to_free_space(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("eventsrc.log.active_segment.sync_file", refuse)
    with pytest.raises(LogError, match="No space left on device; free space on its disk"):
        LogWriter(log_path)


def test_a_large_segment_is_synced_a_few_megabytes_at_a_time(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Syncing all of it at once would keep the disk from the commits of the growing segment."""
    unsynced, synced_to = [], 0
    real = _seal.sync_file

    def sync_file(fd: int) -> None:
        nonlocal synced_to
        size = os.fstat(fd).st_size
        unsynced.append(size - synced_to)
        synced_to = size
        real(fd)

    with LogWriter(log_path, fsync=ALWAYS) as writer:
        for number in range(24):
            writer.append(KEY, random.Random(number).randbytes(1_000_000))
        monkeypatch.setattr(_seal, "sync_file", sync_file)
    (sealed,) = log_path.glob("*.mcap")
    assert synced_to == sealed.stat().st_size > 20_000_000
    assert max(unsynced) < 7_000_000
