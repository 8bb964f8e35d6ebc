"""The file format, checked independently of our writer: with bytes laid out by hand and with the
readers of the mcap package."""

import json
import struct
import zlib
from pathlib import Path

import pytest
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.readers import EnvelopeModel
from eventsrc.envelope.system_events import LOSS_KEY, Loss
from eventsrc.log import Event, LogReader, LogWriter, verify_log
from eventsrc.log.channels import flat_schema
from eventsrc.record.importers.run import import_files
from tests.support.fixtures_log import BY_HAND, KEY, envelope, read_log
from tests.support.rewriting import DuplicateMetadata, merge

MAGIC = bytes([0x89, 0x4D, 0x43, 0x41, 0x50, 0x30, 0x0D, 0x0A])
NAME = "00000000000000000500.mcap.active"


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def mapping(values: dict[str, str]) -> bytes:
    content = b"".join(text(k) + text(v) for k, v in values.items())
    return struct.pack("<I", len(content)) + content


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def head() -> bytes:
    values = {"base": "500", "format": "1", "log_id": "hand", "mark_seed": "0"}
    # docs/log-format.md: CRC-32 of each key and value with its length before it, by key
    canonical = "".join(f"{len(k)}:{k}{len(v)}:{v}" for k, v in sorted(values.items()))
    values["crc32"] = f"{zlib.crc32(canonical.encode()):08x}"
    header = record(0x01, text("mapfold") + text("mapfold"))
    return MAGIC + header + record(0x0C, text("mapfold.segment:hand:500") + mapping(values))


def message(sequence: int, log_ns: int, publish_ns: int, payload: bytes) -> bytes:
    return record(0x05, struct.pack("<HIQQ", 3, sequence, log_ns, publish_ns) + payload)


def chunk(body: bytes) -> bytes:
    times = struct.pack("<QQ", 10, 20)
    sizes = struct.pack("<QI", len(body), zlib.crc32(body))
    return record(0x06, times + sizes + text("") + struct.pack("<Q", len(body)) + body)


def mark(first: int, following: int, seed: int = 0) -> bytes:
    start = struct.pack("<BQQQ", 0x80, 20, first, following)
    return start + struct.pack("<I", zlib.crc32(start) ^ seed)


def schema_and_channel() -> bytes:
    schema = record(0x03, struct.pack("<H", 1) + text("x") + text("jsonschema") + text("{}"))
    metadata = mapping({"mapfold.envelope_version": "1"})
    channel = struct.pack("<HH", 3, 1) + text("some/key") + text("json") + metadata
    return schema + record(0x04, channel)


def channel_alone() -> bytes:
    metadata = mapping({"mapfold.envelope_version": "1"})
    return record(0x04, struct.pack("<HH", 3, 1) + text("some/key") + text("json") + metadata)


EVENTS = [
    Event(500, "some/key", 11, 9, b"first", 1),
    Event(501, "some/key", 10, 8, b"", 1),
    Event(502, "some/key", 20, 2**63 - 1, b"\x00third", 1),
]


def by_hand() -> bytes:
    first = schema_and_channel() + message(0, 11, 9, b"first") + message(1, 10, 8, b"")
    second = channel_alone() + message(2, 20, 2**63 - 1, b"\x00third")
    return head() + chunk(first) + mark(500, 502) + chunk(second) + mark(502, 503)


def test_an_active_segment_made_by_hand_reads(log_path: Path) -> None:
    log_path.mkdir()
    (log_path / NAME).write_bytes(by_hand())
    with LogReader(log_path) as reader:
        assert (reader.log_id, reader.next_offset) == ("hand", 503)
        assert list(reader.read(500)) == EVENTS


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (message(2, 1, 1, b"x"), "3"),  # no channel 3 is defined here
        (channel_alone() + message(3, 1, 1, b"x"), "offset 503 where 502 should be"),
        (channel_alone(), "ends before offset 502"),
        (channel_alone() + record(0x05, b"short"), "cut short"),
        (channel_alone() + message(2, 1, 1, b"x")[:-1], "does not fit"),
        (channel_alone() + message(2, 1, 1, b"x") + b"\x05", "cut short"),
    ],
    ids=["no-channel", "hole", "nothing", "tiny-message", "cut-message", "cut-record"],
)
def test_a_chunk_that_contradicts_itself_is_damage(log_path: Path, body: bytes, says: str) -> None:
    log_path.mkdir()
    good = schema_and_channel() + message(0, 11, 9, b"first") + message(1, 10, 8, b"")
    bad = chunk(body) + mark(502, 503)
    (log_path / NAME).write_bytes(head() + chunk(good) + mark(500, 502) + bad)
    with LogReader(log_path) as reader, pytest.raises(LogDamaged, match=says):
        list(reader.read(500))
    assert [(f.first_offset, f.last_offset) for f in verify_log(log_path).findings][1:2] == [
        (502, 502)
    ]


def test_our_writer_makes_the_same_chunks(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        writer.append(LOSS_KEY, b"one", logged_ns=5, stamp_ns=6, version=1)
        writer.sync()
        writer.append(LOSS_KEY, b"two", logged_ns=7, stamp_ns=8, version=1)
        writer.sync()
        data = next(log_path.glob("*.active")).read_bytes()
    at = data.index(b"mark_seed") + len(b"mark_seed")
    seed = int(data[at + 4 : at + 12], 16)
    metadata = mapping({"mapfold.envelope_version": "1"})
    channel = record(0x04, struct.pack("<HH", 1, 1) + text(LOSS_KEY) + text("json") + metadata)
    body = channel + record(0x05, struct.pack("<HIQQ", 1, 1, 7, 8) + b"two")
    sizes = struct.pack("<QI", len(body), zlib.crc32(body))
    times = struct.pack("<QQ", 7, 7)
    last = record(0x06, times + sizes + text("") + struct.pack("<Q", len(body)) + body)
    assert data.endswith(mark(0, 1, seed) + last + mark(1, 2, seed))


@pytest.fixture
def sealed(log_path: Path) -> Path:
    """A log of three sealed segments with two keys."""
    with LogWriter(log_path, rotate_events=4) as writer:
        for index in range(5):
            writer.append(KEY, envelope(index), logged_ns=100 - index, stamp_ns=index)
            loss = Loss(publisher="r", count=1, cause="queue_full")
            writer.append(LOSS_KEY, loss.model_dump_json().encode(), logged_ns=200, stamp_ns=7)
            writer.sync()
            writer.commit_if_due()
    return log_path


def test_any_mcap_reader_opens_sealed_segments_with_the_right_schema(sealed: Path) -> None:
    seen: list[Event] = []
    schemas: dict[str, object] = {}
    with LogReader(sealed) as log:
        log_id = log.log_id
    for file in sorted(sealed.glob("*.mcap")):
        with file.open("rb") as stream:
            reader = SeekingReader(stream, validate_crcs=True)
            base = int(file.stem)
            assert {m.name for m in reader.iter_metadata()} == {
                f"mapfold.segment:{log_id}:{base}",
                f"mapfold.seal:{log_id}:{base}",
            }
            for schema, channel, found in reader.iter_messages(log_time_order=False):
                assert schema is not None
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                schemas[channel.topic] = json.loads(schema.data)
                offset = base + found.sequence
                times = (found.log_time, found.publish_time)
                seen.append(Event(offset, channel.topic, *times, found.data))
    assert seen == read_log(sealed)
    assert schemas == {KEY: flat_schema(EnvelopeModel), LOSS_KEY: flat_schema(Loss)}


def test_segments_of_two_logs_are_merged_without_an_option(sealed: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    with LogWriter(other) as writer:
        writer.append(KEY, envelope(9), logged_ns=150)
    files = [*sorted(sealed.glob("*.mcap")), *other.glob("*.mcap")]
    assert len(files) == 4
    merge(files, tmp_path / "merged.mcap")
    with LogWriter(tmp_path / "both") as writer:
        import_files(writer, [str(tmp_path / "merged.mcap")])
    of_both = [(e.logged_ns, e.payload) for log in (sealed, other) for e in read_log(log)]
    assert sorted((e.logged_ns, e.payload) for e in read_log(tmp_path / "both")) == sorted(of_both)
    with pytest.raises(DuplicateMetadata):
        merge([files[0], files[0]], tmp_path / "twice.mcap")


def test_the_index_finds_one_topic_and_one_time(sealed: Path) -> None:
    with (sealed / "00000000000000000000.mcap").open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        found = [m.sequence for _, _, m in reader.iter_messages([KEY], ending_at=99)]
        summary = reader.get_summary()
    assert found == [2]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 4


def test_a_stream_reader_checks_every_crc(sealed: Path) -> None:
    for file in sealed.glob("*.mcap"):
        with file.open("rb") as stream:
            kinds = [type(r).__name__ for r in StreamReader(stream, validate_crcs=True).records]
        assert kinds[0] == "Header"
        assert kinds[-1] == "Footer"


def test_a_foreign_mcap_file_is_no_segment(log_path: Path) -> None:
    log_path.mkdir()
    (log_path / NAME).write_bytes(MAGIC + record(0x01, text("ros2") + text("x")) + b"\x0f" * 200)
    with pytest.raises(NotALog, match="mapfold import"):
        LogReader(log_path)
