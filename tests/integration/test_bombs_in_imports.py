"""Import of MCAP files that are bombs or declare false sizes, in bounded memory."""

import gzip
import hashlib
import io
import random
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from eventsrc.envelope.system_events import EXCERPT_BYTES, RejectedPayload
from eventsrc.log.foreign_mcap import ForeignDamage, ForeignMessage, foreign_messages
from eventsrc.log.mcap_records import MAGIC
from tests.support.commands import MOST_MIB, run_measured
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log
from tests.support.thorough import mostly_slow

GIB = 2**30
HEADER = b"\x01" + struct.pack("<QII", 8, 0, 0)
CHANNEL = b"\x04" + struct.pack("<QHHI", 20, 1, 0, 1) + b"k" + struct.pack("<I", 4) + b"json"
CHANNEL = CHANNEL[:1] + struct.pack("<Q", len(CHANNEL) - 9 + 4) + CHANNEL[9:] + bytes(4)
GOOD = payload(envelope(1))


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def message(data: bytes, length: int | None = None) -> bytes:
    content = struct.pack("<HIQQ", 1, 0, 1, 1) + data
    return record(5, content, length)


def chunk(name: bytes, data: bytes, size: int) -> bytes:
    head = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    return record(6, head + struct.pack("<Q", len(data)) + data)


def zeros(compress: Callable[[bytes], bytes], flush: Callable[[], bytes]) -> bytes:
    """A gibibyte of them, squeezed."""
    block = bytes(2**24)
    return b"".join(compress(block) for _ in range(GIB // len(block))) + flush()


@cache
def zstd_bomb(named: bool) -> bytes:
    """``named``: the frame says how large its content is."""
    squeeze = zstandard.ZstdCompressor().compressobj(size=GIB if named else -1)
    return zeros(squeeze.compress, squeeze.flush)


def lz4_bomb() -> bytes:
    squeeze = lz4.frame.LZ4FrameCompressor()
    return squeeze.begin() + zeros(squeeze.compress, squeeze.flush)


BOMBS: dict[str, Callable[[], bytes]] = {
    "a zstd frame that says so": lambda: chunk(b"zstd", zstd_bomb(True), GIB),
    "a chunk that says less than its zstd frame": lambda: chunk(b"zstd", zstd_bomb(True), 1000),
    "a zstd frame without a size": lambda: chunk(b"zstd", zstd_bomb(False), 1000),
    "a chunk that says it holds a gibibyte": lambda: chunk(b"zstd", zstd_bomb(False), GIB),
    "lz4": lambda: chunk(b"lz4", lz4_bomb(), 1000),
    "lz4 that says so": lambda: chunk(b"lz4", lz4_bomb(), GIB),
    "a chunk of exbibytes": lambda: chunk(b"", b"", 2**62),
    "a message of exbibytes": lambda: message(b"x", 2**62),
    "a record of exbibytes": lambda: record(7, b"", 2**63),
    "a channel without end": lambda: record(4, bytes(2**25)),
    "a chunk in which a message is longer": lambda: chunk(b"", message(b"x", 2**40), 32),
}


@pytest.mark.parametrize("name", mostly_slow(BOMBS, 3))
def test_a_bomb_ends_the_import_with_its_place_and_little_memory(name: str, tmp_path: Path) -> None:
    file, log = tmp_path / "bomb.mcap", tmp_path / "log"
    before = MAGIC + HEADER + CHANNEL + message(GOOD)
    file.write_bytes(before + BOMBS[name]())
    ran = run_measured("import", log, file)
    assert ran.code == 1, ran.said
    assert f"{file}: torn, damaged or over a limit, at byte {len(before):,}" in ran.said
    assert "the messages before it are in the log" in ran.said
    assert "Traceback" not in ran.said
    assert ran.peak_mib < MOST_MIB / 2
    assert [e.payload for e in read_log(log)] == [GOOD]


LARGE = 70_000_000
CHUNKS: dict[str, Callable[[bytes], bytes]] = {
    "in no chunk": lambda records: records,
    "in a chunk": lambda records: chunk(b"", records, len(records)),
    "in a zstd chunk": lambda records: chunk(
        b"zstd", zstandard.ZstdCompressor().compress(records), len(records)
    ),
    "in an lz4 chunk": lambda records: chunk(b"lz4", lz4.frame.compress(records), len(records)),
}


@pytest.mark.seconds
@pytest.mark.parametrize("packed", mostly_slow(CHUNKS))
def test_of_a_message_that_is_too_large_an_excerpt_is_kept(packed: str, tmp_path: Path) -> None:
    file, log = tmp_path / "large.mcap", tmp_path / "log"
    large = GOOD[:-1] + b"y" * (LARGE - len(GOOD) + 1)
    around = MAGIC + HEADER + CHANNEL + CHUNKS[packed](message(GOOD) + message(large))
    file.write_bytes(around + message(GOOD) + record(2, bytes(20)) + MAGIC)
    ran = run_measured("import", log, file)
    assert (ran.code, ran.peak_mib < MOST_MIB / 2) == (3, True), ran
    first, refused, last = read_log(log)
    assert first.payload == last.payload == GOOD
    kept = RejectedPayload.model_validate_json(refused.payload)
    assert kept.raw == large[:EXCERPT_BYTES]
    assert (kept.size, kept.sha256) == (LARGE, hashlib.sha256(large).hexdigest())
    assert "payload of 70,000,000 bytes, more than the 67,108,864" in kept.reason


@pytest.mark.seconds
def test_a_line_that_is_too_long_is_refused_and_the_next_is_read(tmp_path: Path) -> None:
    file, log = tmp_path / "large.jsonl.gz", tmp_path / "log"
    line = b'{"x": "' + b"y" * 80_000_000 + b'"}'
    file.write_bytes(gzip.compress(GOOD + b"\n" + line + b"\n" + GOOD, 1))
    ran = run_measured("import", log, file)
    assert (ran.code, ran.peak_mib < MOST_MIB / 2) == (3, True), ran
    _, refused, last = read_log(log)
    assert last.payload == GOOD
    kept = RejectedPayload.model_validate_json(refused.payload)
    assert (kept.size, kept.sha256) == (len(line), hashlib.sha256(line).hexdigest())


@pytest.mark.slow
def test_other_channels_are_skipped_whatever_their_size(tmp_path: Path) -> None:
    """An attachment of two gibibytes, most of it a hole."""
    file, log = tmp_path / "file.mcap", tmp_path / "log"
    with file.open("wb") as out:
        out.write(MAGIC + HEADER + CHANNEL + record(9, b"", 2 * GIB))
        out.seek(2 * GIB, 1)
        out.write(message(GOOD) + record(2, bytes(20)) + MAGIC)
    ran = run_measured("import", log, file)
    assert (ran.code, ran.peak_mib < MOST_MIB / 2) == (0, True), ran
    assert [e.payload for e in read_log(log)] == [GOOD]


@pytest.fixture(scope="module", params=list(CompressionType), ids=lambda c: c.name)
def whole(request: pytest.FixtureRequest) -> bytes:
    """A file of twelve messages in chunks."""
    file = io.BytesIO()
    writer = Writer(file, compression=request.param, chunk_size=200)
    writer.start()
    ids = [writer.register_channel(f"k{n}", "json", 0) for n in range(2)]
    for number in range(12):
        writer.add_message(ids[number % 2], number, b'{"n": %d}' % number, number)
    writer.add_attachment(1, 2, "name", "text/plain", b"attached")
    writer.finish()
    return file.getvalue()


def read(data: bytes) -> tuple[list[ForeignMessage], bool]:
    found: list[ForeignMessage] = []
    try:
        found.extend(foreign_messages(io.BytesIO(data)))
    except ForeignDamage:
        return found, False
    return found, True


def test_every_message_of_a_good_file_is_read(whole: bytes) -> None:
    found, good = read(whole)
    assert good
    assert [(m.key, m.logged_ns, m.payload) for m in found] == [
        (f"k{n % 2}", n, b'{"n": %d}' % n) for n in range(12)
    ]


@given(data=st.data())
def test_a_changed_file_raises_only_foreign_damage(whole: bytes, data: st.DataObject) -> None:
    changed = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(changed)))
        length = data.draw(st.integers(0, 9))
        changed[at : at + length] = data.draw(st.binary(max_size=9) | st.just(b"\xff" * 8))
    read(bytes(changed))


def test_a_cut_file_gives_the_messages_before_the_cut(whole: bytes) -> None:
    everything, _ = read(whole)
    chance = random.Random(1)
    for at in sorted(chance.sample(range(len(whole)), 40)):
        found, good = read(whole[:at])
        assert not good
        assert found == everything[: len(found)]
