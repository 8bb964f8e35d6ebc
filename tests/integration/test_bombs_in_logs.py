"""Segments that are huge, full of holes, or declare sizes that are not true."""

import os
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zstandard

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.log import LogWriter, recover_log
from eventsrc.log import mcap_records as _mcap
from eventsrc.log import seal as _seal
from eventsrc.log.format import (
    ACTIVE,
    SEALED,
    file_head,
    head_metadata,
    list_segments,
    segment_path,
)
from eventsrc.log.log_identity import common_log_id
from eventsrc.log.mcap_records import ChunkIndex, Statistics
from eventsrc.log.recover import TooManyLosses
from tests.support.commands import MOST_MIB, run_measured
from tests.support.fixtures_log import BY_HAND, KEY, envelope, flip, read_log, write_log
from tests.support.thorough import THOROUGH, mostly_slow

HUGE = 20 * 2**30
EVENTS = 6
GIB = 2**30
DATA_END = b"\x0f" + (4).to_bytes(8, "little")
MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)
"""A message without payload."""


@pytest.fixture
def log(log_path: Path) -> Path:
    """A sealed segment of three events and a growing one of three."""
    write_log(log_path, [envelope(k) for k in range(3)])
    writer = LogWriter(log_path, fsync=BY_HAND)
    for k in range(3, EVENTS):
        writer.append(KEY, envelope(k))
    writer.sync()
    writer._active.close()
    writer._lock.release()
    return log_path


def sealed(log: Path) -> Path:
    return segment_path(log, 0, SEALED)


def active(log: Path) -> Path:
    return segment_path(log, 3, ACTIVE)


def growing_with_a_hole(log: Path) -> None:
    os.truncate(active(log), HUGE)


def growing_that_is_nothing_but_a_hole(log: Path) -> None:
    os.truncate(active(log), 0)
    os.truncate(active(log), HUGE)


def sealed_with_a_hole(log: Path) -> None:
    os.truncate(sealed(log), HUGE)


def sealed_with_a_hole_before_its_footer(log: Path) -> None:
    """So that the footer declares a summary of twenty gibibytes."""
    tail = sealed(log).read_bytes()[-_mcap.TAIL_BYTES :]
    os.truncate(sealed(log), HUGE)
    with sealed(log).open("ab") as file:
        file.write(tail)


@cache
def zstd_of_zeros(size: int) -> tuple[bytes, int]:
    """The frame, which names its size, and the CRC of its content."""
    squeeze = zstandard.ZstdCompressor().compressobj(size=size)
    block, crc, data = bytes(2**24), 0, b""
    for _ in range(size // len(block)):
        data += squeeze.compress(block)
        crc = zlib.crc32(block, crc)
    return data + squeeze.flush(), crc


def growing_with_a_bomb(log: Path) -> None:
    data, crc = zstd_of_zeros(GIB)
    head = _mcap._CHUNK.pack(6, 44 + len(data), 0, 0, GIB, crc, 4)
    with active(log).open("ab") as file:
        file.write(head + b"zstd" + len(data).to_bytes(8, "little") + data)


HUGE_FILES = [
    growing_with_a_bomb,
    sealed_with_a_hole_before_its_footer,
    *(
        pytest.param(spoil, marks=pytest.mark.slow)
        for spoil in (
            growing_with_a_hole,
            growing_that_is_nothing_but_a_hole,
            sealed_with_a_hole,
        )
    ),
]


@pytest.mark.parametrize("spoil", HUGE_FILES)
def test_no_command_takes_much_memory_or_ends_in_a_traceback(
    log: Path, tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    spoil(log)
    more = tmp_path / "more.jsonl"
    more.write_bytes(envelope(EVENTS) + b"\n")
    commands: list[tuple[str | Path, ...]] = [
        ("log", "verify", log),
        ("log", "info", log),
        ("log", "cat", log),
        ("state", log),
        ("import", tmp_path / "other", log),
        ("import", log, more),
        ("log", "recover", log),
        ("import", log, more),
    ]
    for command in commands:
        ran = run_measured(*command)
        assert ran.peak_mib < MOST_MIB, command
        assert "Traceback" not in ran.said, (command, ran.said)
        assert ran.code in (0, 1, 2, 3), (command, ran.said)
    kept = [e.payload for e in read_log(log) if e.key == KEY]
    assert envelope(EVENTS) in kept
    if spoil is not growing_that_is_nothing_but_a_hole:
        assert kept[:EVENTS] == [envelope(k) for k in range(EVENTS)], "all that was recorded"


def test_the_holes_of_a_damaged_segment_cannot_have_held_events(log: Path) -> None:
    """They would allow for millions of loss events without a question."""
    os.truncate(sealed(log), HUGE)
    base = 1_000_000
    active(log).unlink()
    log_id = common_log_id(list_segments(log)) or ""
    head = file_head(head_metadata(log_id, base, {"mark_seed": "0"}))
    segment_path(log, base, ACTIVE).write_bytes(head)
    with pytest.raises(TooManyLosses, match="999,997 events from offset 3"):
        recover_log(log)


def forge(field: str, value: Any) -> Callable[..., ChunkIndex]:
    """A chunk index that says something else in one field."""
    return lambda **fields: ChunkIndex(**{**fields, field: value})


@pytest.mark.parametrize(
    "what",
    mostly_slow(
        [
            {"ChunkIndex": forge("chunk_start_offset", 2**63)},
            {"MetadataIndex": lambda at, size, name: _mcap.MetadataIndex(at, 2**62, name)},
            {"Statistics": lambda **f: Statistics(**{**f, "channel_message_counts": {9: 1}})},
            {"ChunkIndex": forge("chunk_length", 2**40)},
            {"ChunkIndex": forge("chunk_length", 2**64 - 1)},
            {"MetadataIndex": lambda at, size, name: _mcap.MetadataIndex(2**63, size, name)},
            {"MetadataIndex": lambda at, size, name: _mcap.MetadataIndex(at, size, "other")},
        ],
        quick=3,
    ),
)
def test_places_beyond_the_file_are_damage_and_recovered(
    log_path: Path, what: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every checksum of the file is right."""
    with monkeypatch.context() as patch:
        patch.setattr(_seal, "_mcap", SimpleNamespace(**{**vars(_mcap), **what}))
        write_log(log_path, [envelope(k) for k in range(3)])
    with pytest.raises(LogDamaged, match="run `mapfold log recover"):
        read_log(log_path)
    commands = ("info", "cat", "verify", "recover", "cat") if THOROUGH else ("verify", "recover")
    for command in commands:
        ran = run_measured("log", command, log_path)
        assert "Traceback" not in ran.said, (command, ran.said)
        assert ran.peak_mib < MOST_MIB
        if command == "verify":
            assert ran.code == 3
    assert [e.payload for e in read_log(log_path)] == [envelope(k) for k in range(3)]


def test_a_sealed_chunk_that_decompresses_to_a_gibibyte_is_named_not_read(log: Path) -> None:
    data, crc = zstd_of_zeros(GIB)
    head = _mcap._CHUNK.pack(6, 44 + len(data), 0, 0, GIB, crc, 4)
    record = head + b"zstd" + len(data).to_bytes(8, "little") + data
    with pytest.raises(_mcap.BadRecord, match="declares 1,073,741,824 bytes, more than"):
        _mcap.decode_chunk(record)


def test_an_event_that_could_not_be_read_again_is_not_taken(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        with pytest.raises(LogError, match=r"100,663,297 bytes under 'k' are more than"):
            writer.append("k", bytes(_mcap.MAX_EVENT_BYTES + 1))
        assert writer.next_offset == 0
        assert writer.append("k", b"{}") == 0


@pytest.mark.slow
def test_the_largest_group_and_event_are_read_again(log_path: Path) -> None:
    """As large as a chunk gets, growing and sealed."""
    writer = LogWriter(log_path, fsync=BY_HAND)
    small, large = b"s" * (_mcap.MAX_GROUP_BYTES - 100), b"l" * _mcap.MAX_EVENT_BYTES
    writer.append_all([_event(small), _event(large)])
    writer.sync()
    assert [e.payload for e in read_log(log_path)] == [small, large]
    writer.close()
    assert [e.payload for e in read_log(log_path)] == [small, large]
    flip(segment_path(log_path, 0, SEALED), -40)
    ran = run_measured("log", "recover", log_path)
    assert (ran.code, ran.peak_mib < MOST_MIB) == (0, True), ran
    assert [e.payload for e in read_log(log_path)] == [small, large]
    for command in (("log", "verify"), ("log", "info"), ("state",)):
        assert run_measured(*command, log_path).peak_mib < MOST_MIB, command


def _event(payload: bytes) -> Any:
    from eventsrc.log import NewEvent

    return NewEvent("k", payload, 1, 1)
