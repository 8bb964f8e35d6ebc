"""The snapshot cache: usable snapshots are used, others are passed over with a note."""

import contextlib
import hashlib
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eventsrc.log import ALWAYS, LogReader, LogWriter, recover_log
from projections.fold.settings import Settings
from projections.map import fold as folding
from projections.map import snapshot as codec
from projections.map.digest import map_digest
from projections.map.fold import fold_log, fold_log_cached
from projections.map.snapshot import (
    MAGIC,
    MalformedSnapshot,
    SnapshotRefused,
    pack,
    restore,
    snapshot,
    unpack,
)
from projections.map.snapshot_cache import SnapshotCache
from tests.envelopes import detection, envelope, payload
from tests.folds import Folded, fold

KEY = "tb/detections"


def _documents(count: int) -> list[dict[str, Any]]:
    return [
        envelope(i, i % 17 / 4, i % 5 / 3, detections=[detection("cup", [1.0, i % 3, 0.5])])
        for i in range(count)
    ]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log"
    with LogWriter(path) as writer:
        for document in _documents(60):
            writer.append(KEY, payload(document))
    return path


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Snapshots are worth it from one event on."""
    monkeypatch.setattr(folding, "SNAPSHOT_MIN_EVENTS", 1)


def _digest(log: Path, until: int, notes: list[str], **settings: Any) -> str:
    with LogReader(log) as reader:
        _, view = fold_log_cached(reader, Settings(**settings), until, note=notes.append)
    assert view.next_offset == until
    return map_digest(view)


def _plain_digest(log: Path, until: int) -> str:
    with LogReader(log) as reader:
        return map_digest(fold_log(reader, Settings(), until)[1])


def _files(log: Path) -> list[Path]:
    return sorted(log.with_name("log.snapshots").iterdir())


@pytest.mark.usefixtures("eager")
def test_a_fold_continues_from_the_nearest_snapshot(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    assert _digest(log, 30, notes) == _plain_digest(log, 30)
    starts = []
    read = LogReader.read
    monkeypatch.setattr(
        LogReader, "read", lambda self, start, end: starts.append(start) or read(self, start, end)
    )
    assert _digest(log, 50, notes) == _plain_digest(log, 50)
    assert _digest(log, 20, notes) == _plain_digest(log, 20)
    assert starts == [30, 0, 0, 0]  # ours from 30; the plain one; from 0, as 30 is beyond 20; plain
    assert notes == []


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text"])
def test_a_damaged_snapshot_is_passed_over_with_a_note(log: Path, damage: str) -> None:
    notes: list[str] = []
    _digest(log, 30, notes)
    (path,) = _files(log)
    data = path.read_bytes()
    flipped = data[:-20] + bytes([data[-20] ^ 1]) + data[-19:]
    path.write_bytes({"cut": data[:-7], "flip": flipped, "empty": b"", "text": b"hello"}[damage])
    assert _digest(log, 40, notes) == _plain_digest(log, 40)
    (note,) = notes
    assert str(path) in note
    assert "safe to delete" in note


@pytest.mark.usefixtures("eager")
def test_a_damaged_snapshot_is_replaced_by_a_sound_one_of_the_same_offset(log: Path) -> None:
    """Else it would cost a whole fold and a note forever."""
    notes: list[str] = []
    _digest(log, 30, notes)
    (path,) = _files(log)
    path.write_bytes(path.read_bytes()[:-7])
    assert _digest(log, 30, notes) == _plain_digest(log, 30)
    assert len(notes) == 1
    assert _digest(log, 30, notes) == _plain_digest(log, 30)
    assert len(notes) == 1
    assert _files(log) == [path]


@pytest.mark.usefixtures("eager")
def test_a_snapshot_of_another_log_or_version_is_passed_over(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    with LogWriter(other) as writer:
        for document in _documents(60)[::-1]:
            writer.append(KEY, payload(document))
    notes: list[str] = []
    _digest(other, 30, notes)
    (tmp_path / "other.snapshots").rename(tmp_path / "log.snapshots")
    assert _digest(log, 40, notes) == _plain_digest(log, 40)
    assert "of the log" in notes.pop()
    monkeypatch.setattr(codec, "FOLD_VERSION", 99)
    assert _digest(log, 40, notes) == _plain_digest(log, 40)
    assert all("fold version" in note for note in notes if "of the log" not in note)
    assert notes


@pytest.mark.usefixtures("eager")
def test_settings_do_not_share_snapshots(log: Path) -> None:
    notes: list[str] = []
    _digest(log, 30, notes)
    _digest(log, 30, notes, eps_m=0.3)
    assert len({path.name.partition("-")[0] for path in _files(log)}) == 2
    assert notes == []


@pytest.mark.usefixtures("eager")
def test_a_cache_that_cannot_be_written_is_a_note(log: Path) -> None:
    log.with_name("log.snapshots").write_text("in the way")
    notes: list[str] = []
    assert _digest(log, 30, notes) == _plain_digest(log, 30)
    assert "no snapshot was kept" in notes[-1]


@pytest.mark.usefixtures("eager")
def test_a_few_snapshots_are_kept_the_newest_among_them(log: Path) -> None:
    for until in range(1, 60, 4):
        _digest(log, until, [])
    with LogReader(log) as reader:
        offsets = SnapshotCache(log, reader.log_id, Settings(), note=lambda _: None).offsets()
    assert len(offsets) == 6
    assert offsets[-1] == 57
    assert offsets[0] == 1


def test_a_short_fold_leaves_nothing_behind(log: Path) -> None:
    _digest(log, 60, [])
    assert not log.with_name("log.snapshots").exists()


@pytest.mark.usefixtures("eager")
def test_a_snapshot_of_events_that_the_log_has_lost_is_not_used(tmp_path: Path) -> None:
    """Else the map would show what cannot be read any more."""
    log = tmp_path / "log"
    with LogWriter(log, fsync=ALWAYS, rotate_events=20) as writer:
        for document in _documents(60):
            writer.append(KEY, payload(document))
    notes: list[str] = []
    before = _digest(log, 60, notes)
    assert _digest(log, 60, notes) == before
    assert notes == []
    middle = sorted(log.glob("*.mcap"))[1]
    data = bytearray(middle.read_bytes())
    data[data.index(b"zstd") + 20] ^= 1  # in the compressed events
    middle.write_bytes(data)
    assert recover_log(log).segments[0].gaps
    after = _digest(log, 60, notes)
    assert after == _plain_digest(log, 60) != before
    assert "the log has lost events since it was made" in notes[0]


@pytest.mark.usefixtures("eager")
def test_a_snapshot_outlives_the_sealing_of_its_segment(tmp_path: Path) -> None:
    path = tmp_path / "growing"
    notes: list[str] = []
    with LogWriter(path, fsync=ALWAYS) as writer:
        for document in _documents(30):
            writer.append(KEY, payload(document))
        _digest(path, 30, notes)
    with LogReader(path) as reader:
        cache = SnapshotCache(path, reader.log_id, Settings(), notes.append)
        assert cache.latest(30) is not None
    assert notes == []


def test_restore_refuses_other_settings() -> None:
    folded = fold(_documents(5))
    data = snapshot(folded.map, folded.view, "log")
    with pytest.raises(SnapshotRefused, match="other settings"):
        restore(data, Settings(eps_m=0.1), "log")
    with pytest.raises(SnapshotRefused, match="other settings"):
        restore(data, Settings(places="rooms"), "log")


@pytest.mark.parametrize("instead", [None, 7, "x", [], [[1]], {}, 1 << 70, np.zeros((2, 2))])
@pytest.mark.parametrize("settings", [Settings(), Settings(places="rooms")])
def test_restore_refuses_content_that_does_not_fit_together(
    settings: Settings, instead: Any
) -> None:
    """Whatever stands in place of any value, by another hand: a refusal, or a map, but no crash."""
    folded = Folded.start(settings).extend(_documents(5))
    state = unpack(snapshot(folded.map, folded.view, "log"))
    for name in state:
        if not name.startswith("about."):
            with contextlib.suppress(SnapshotRefused):
                restore(pack(state | {name: instead}), settings, "log")
    for name in ("map.places.joined", "map.seen.offsets", "view.keyframes"):
        with pytest.raises(SnapshotRefused, match="does not fit together"):
            restore(pack({k: v for k, v in state.items() if k != name}), settings, "log")


def test_bytes_with_another_head_or_checksum_are_refused() -> None:
    with pytest.raises(MalformedSnapshot, match="does not begin"):
        unpack(b"\x80\x04pickle")
    body = zlib.compress(b"")
    with pytest.raises(MalformedSnapshot, match="checksum"):
        unpack(MAGIC + b"0" * 32 + body)


@pytest.mark.seconds
def test_a_decompression_bomb_is_refused() -> None:
    squeeze = zlib.compressobj(1)
    first, again = (
        squeeze.compress(bytes(1_000_000)) + squeeze.flush(zlib.Z_FULL_FLUSH) for _ in range(2)
    )
    body = first + 499 * again + squeeze.flush()
    assert len(body) < 4_000_000
    with pytest.raises(MalformedSnapshot, match="decompresses to more than"):
        unpack(MAGIC + hashlib.sha256(body).digest() + body)
