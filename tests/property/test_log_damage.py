"""An active segment cut at any byte or with any byte flipped: synced events are read or named."""

import contextlib
import shutil
from pathlib import Path

from eventsrc.base.errors import LogError
from eventsrc.log import Event, LogWriter
from eventsrc.log.durable_files import ALWAYS
from eventsrc.log.mcap_records import MARK_BYTES
from eventsrc.log.scan import scan_active
from tests.support.fixtures_log import BY_HAND, KEY, read_log, read_with_gaps
from tests.support.thorough import stride

MEMORY_DISK = Path("/dev/shm")


def make_active(path: Path) -> tuple[Path, list[Event], dict[int, int]]:
    """An active segment of five commits left behind, its events, and its durable size by offset."""
    writer = LogWriter(path, fsync=BY_HAND)
    file = next(path.glob("*.active"))
    durable_at = {0: file.stat().st_size}
    for count in (1, 3, 1, 2, 1):
        for _ in range(count):
            number = writer.next_offset
            writer.append(KEY, b"payload %d" % number, stamp_ns=number, logged_ns=9)
        writer.sync()
        durable_at[writer.durable_offset] = file.stat().st_size
    events = read_log(path)
    copy = path.parent / "copy"
    shutil.copytree(path, copy)
    writer.close()
    return next(copy.glob("*.active")), events, durable_at


def test_a_cut_at_any_byte_leaves_a_prefix_with_everything_synced(quick_path: Path) -> None:
    file, events, durable_at = make_active(quick_path / "log")
    data = file.read_bytes()
    for cut in (*range(0, len(data), stride(17)), len(data)):
        log = quick_path / "cut"
        log.mkdir()
        (log / file.name).write_bytes(data[:cut])
        synced = max((o for o, size in durable_at.items() if size <= cut), default=0)
        seen = []
        if cut >= durable_at[0]:
            seen = read_log(log)
            assert seen == events[:synced]
        with LogWriter(log, fsync=ALWAYS) as writer:
            recovered = writer.next_offset
            assert recovered >= len(seen)
            writer.append(KEY, b"next")
        back = read_log(log)
        assert back[:-1] == events[:recovered]
        assert recovered >= synced
        assert (back[-1].offset, back[-1].payload) == (recovered, b"next")
        shutil.rmtree(log)


def test_any_flip_in_an_active_segment_is_reported(quick_path: Path) -> None:
    file, events, durable_at = make_active(quick_path / "log")
    data = bytearray(file.read_bytes())
    everything = set(range(len(events)))
    for at in range(0, len(data), stride(7)):
        data[at] ^= 0x41
        file.write_bytes(data)
        scan = scan_active(file, 0)
        kept = {o for chunk in scan.chunks for o in range(chunk.first, chunk.following)}
        lost = {o for first, last in scan.gaps for o in range(first, last + 1)}
        assert kept | lost == everything
        assert not kept & lost
        if at >= durable_at[0]:
            assert len(kept) >= len(events) - 3, "one flip cost more than one commit"
            shown, named = read_with_gaps(file.parent)
            assert all(event == events[event.offset] for event in shown)
            missing = everything - {e.offset for e in shown} - named
            # Without its mark only recovery may say that the last commit was synced.
            assert not missing or (missing == {len(events) - 1} and at >= len(data) - MARK_BYTES)
        else:
            with contextlib.suppress(LogError):
                assert read_log(file.parent) == events
        data[at] ^= 0x41
