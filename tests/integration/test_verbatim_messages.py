"""Verbatim messages in a log: written, sealed, damaged, recovered, read by others, not folded."""

import threading
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from eventsrc.base.errors import LogError
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.model import Offset
from eventsrc.log import (
    Event,
    LogReader,
    LogWriter,
    MessageFormat,
    NewEvent,
    VerbatimEvent,
    follow,
    recover_log,
    verify_log,
)
from eventsrc.log.format import list_segments
from eventsrc.log.seek import resolve, resolve_start
from eventsrc.record.gap_history import fold_ledger
from eventsrc.record.importers.run import import_files
from eventsrc.record.log_info import log_info
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from tests.support.commands import Commands
from tests.support.fixtures_log import BY_HAND, KEY, envelope, read_log
from tests.support.logs import BOXES, JPEG, TF, mixed_event, mixed_events
from tests.support.thorough import rounds

COUNT = 240


def write_mixed(path: Path, count: int = COUNT, *, per_commit: int = 7, rotate: int = 60) -> None:
    """A closed log of `mixed_events`, in segments of ``rotate`` events."""
    with LogWriter(path, fsync=BY_HAND, rotate_events=rotate) as writer:
        for first in range(0, count, per_commit):
            upto = min(first + per_commit, count)
            writer.append_all([mixed_event(offset) for offset in range(first, upto)])
            writer.sync()
            writer.commit_if_due()


@pytest.fixture
def mixed(log_path: Path) -> Path:
    """The path of a closed log of `mixed_events`."""
    write_mixed(log_path)
    return log_path


def envelopes_alone(path: Path, count: int = COUNT) -> Path:
    """A log of the envelopes of `mixed_events`, and nothing else."""
    with LogWriter(path) as writer:
        writer.append_all([mixed_event(offset) for offset in range(3, count, 4)])
    return path


def digest(log: Path, until: int | None = None) -> str:
    """The digest of a log's map."""
    with LogReader(log) as reader:
        return map_digest(fold_log(reader, Settings(), None if until is None else Offset(until))[1])


def test_what_is_written_is_read_from_growing_and_from_sealed_segments(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND, rotate_events=100) as writer:
        for offset in range(90):
            writer.append_all([mixed_event(offset)])
            if offset % 11 == 0:
                writer.sync()
        writer.sync()
        assert read_log(log_path) == mixed_events(90)
        assert read_log(log_path, 41, 44) == mixed_events(44)[41:]
        assert next(iter(read_log(log_path, 89))).offset == 89
        writer.append_all([mixed_event(offset) for offset in range(90, 120)])
        writer.sync()
        writer.commit_if_due()
        writer.append_all([mixed_event(offset) for offset in range(120, 250)])
    assert [segment.sealed for segment in list_segments(log_path)] == [True] * 2
    assert read_log(log_path) == mixed_events(250)
    assert verify_log(log_path).findings == ()


def test_a_chunk_of_a_growing_segment_has_the_schemas_of_its_messages(log_path: Path) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        for offset in range(40):
            writer.append_all([mixed_event(offset)])
            writer.sync()
        with LogReader(log_path) as reader:
            for offset in range(40):
                (event,) = reader.read(Offset(offset), Offset(offset + 1))
                assert event == mixed_events(40)[offset]


def test_official_readers_show_topics_encodings_schemas_and_bytes(mixed: Path) -> None:
    expected = mixed_events(COUNT)
    seen = 0
    for segment in list_segments(mixed):
        with segment.path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
                event = expected[segment.base + message.sequence]
                assert (channel.topic, message.data) == (event.key, event.payload)
                assert (message.log_time, message.publish_time) == (event.logged_ns, event.stamp_ns)
                if isinstance(event, VerbatimEvent):
                    form = event.format
                    assert channel.message_encoding == form.encoding
                    named = ("", "", b"") if schema is None else (schema.name, schema.encoding)
                    if schema is not None:
                        assert (*named, schema.data) == form[1:]
                    else:
                        assert form == JPEG
                else:
                    assert schema is not None
                    assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
                seen += 1
    assert seen == COUNT


def test_a_stream_reader_finds_every_schema_before_its_channel_in_a_growing_file(
    log_path: Path,
) -> None:
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        for offset in range(20):
            writer.append_all([mixed_event(offset)])
            writer.sync()
        (active,) = list_segments(log_path)
        schemas, channels = {0}, set()
        with active.path.open("rb") as file:
            try:
                for record in StreamReader(file, emit_chunks=False).records:
                    name = type(record).__name__
                    if name == "Schema":
                        schemas.add(record.id)  # type: ignore[attr-defined]
                    elif name == "Channel":
                        assert record.schema_id in schemas  # type: ignore[attr-defined]
                        channels.add(record.topic)  # type: ignore[attr-defined]
            except EndOfFile:
                pass
        assert channels == {"/tf", "/detections", "tb/crops", KEY}


def test_the_map_is_that_of_the_envelopes_alone(mixed: Path, tmp_path: Path) -> None:
    alone = envelopes_alone(tmp_path / "alone")
    assert digest(mixed) == digest(alone)
    for number in (0, 1, 17, 59):
        assert digest(mixed, 4 * number + 4) == digest(alone, number + 1)
        assert digest(mixed, 4 * number + 3) == digest(alone, number)


def test_points_are_found_among_envelopes_only(mixed: Path, tmp_path: Path) -> None:
    alone = envelopes_alone(tmp_path / "alone")
    texts = ("drive:0", "drive:31", "drive:59", "1970-01-01T00:16:40Z", "1970-01-01T00:17:03.5Z")
    with LogReader(mixed) as reader, LogReader(alone) as other:
        for text in texts:
            assert digest(mixed, resolve(reader, text)) == digest(alone, resolve(other, text))
            first = resolve_start(reader, text)
            assert (first - 3) / 4 == resolve_start(other, text)


def test_gaps_info_and_verify_count_envelopes_only(mixed: Path) -> None:
    ledger = fold_ledger(read_log(mixed), GapLedger(), 0)
    assert ledger.missing == 0
    found = log_info(mixed)
    assert found.keys == {"/detections": 60, "/tf": 60, KEY: 60, "tb/crops": 60}
    assert found.formats == {
        "/detections": ("cdr vision_msgs/msg/Detection2DArray",),
        "/tf": ("cdr tf2_msgs/msg/TFMessage",),
        "tb/crops": ("jpeg",),
    }
    assert (found.first_stamp_ns, found.last_stamp_ns) == (1000 * 10**9, 1059 * 10**9)
    assert verify_log(mixed).findings == ()


def test_a_tail_gets_every_message(mixed: Path) -> None:
    stop, got = threading.Event(), []
    for event in follow(mixed, Offset(0), stop=stop):
        if event is None:
            break
        got.append(event)
    assert got == mixed_events(COUNT)


def test_a_killed_writer_and_its_successor_keep_all(log_path: Path) -> None:
    writer = LogWriter(log_path, fsync=BY_HAND)
    writer.append_all([mixed_event(offset) for offset in range(30)])
    writer.sync()
    writer._lock.release()  # as a kill does; the file stays as it is
    with LogWriter(log_path, fsync=BY_HAND) as after:
        assert after.next_offset == 30
        after.append_all([mixed_event(offset) for offset in range(30, 50)])
    assert read_log(log_path) == mixed_events(50)


@pytest.mark.parametrize("victim", [0, 1, 3])
def test_recovery_keeps_formats_whichever_chunk_rots(log_path: Path, victim: int) -> None:
    """Also if it is the first, the only one with the schemas of the whole segment's start."""
    big = MessageFormat("cdr", "a/msg/Big", "ros2msg", b"uint8[] data")
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        for offset in range(8):
            events = [NewEvent("/big", bytes([offset]) * 700_000, 1, 1, format=big)]
            writer.append_all([*events, NewEvent(KEY, envelope(offset), 1, 1)])
            writer.sync()
    (sealed,) = list_segments(log_path)
    before = read_log(log_path)
    with LogReader(log_path) as reader:
        chunk = reader.open_segment(reader.segments[0]).chunks[victim]
    data = bytearray(sealed.path.read_bytes())
    data[chunk.position + chunk.length // 2] ^= 1
    sealed.path.write_bytes(data)
    report = recover_log(log_path)
    assert sum(s.lost_events for s in report.segments) == chunk.following - chunk.first
    for event, was in zip(read_log(log_path), before, strict=True):
        if chunk.first <= event.offset < chunk.following:
            assert event.key == "mapfold/loss"
        else:
            assert event == was
    assert {f.kind for f in verify_log(log_path).findings} <= {"loss"}


def test_without_its_index_a_segment_keeps_its_formats(mixed: Path) -> None:
    first = list_segments(mixed)[0]
    data = first.path.read_bytes()
    first.path.write_bytes(data[:-200])
    recover_log(mixed)
    assert read_log(mixed) == mixed_events(COUNT)


def test_import_takes_messages_over_from_a_log_and_from_a_segment(
    mixed: Path, tmp_path: Path
) -> None:
    segments = [str(segment.path) for segment in list_segments(mixed)]
    for names in ([str(mixed)], segments):
        copy = tmp_path / f"copy-{len(names)}"
        with LogWriter(copy) as writer:
            report = import_files(writer, names)
        assert (report.accepted, report.verbatim, report.skipped) == (60, 180, 0)
        kept = [e for e in read_log(copy) if isinstance(e, VerbatimEvent)]
        assert kept == [e for e in mixed_events(COUNT) if isinstance(e, VerbatimEvent)]
        assert digest(copy) == digest(mixed)


def test_log_cat_and_info_show_what_they_are(mixed: Path) -> None:
    run = Commands.in_folder(mixed.parent)
    lines = run("log", "cat", "log", "--to", "4").out.splitlines()
    assert "/tf  cdr tf2_msgs/msg/TFMessage, " in lines[0]
    assert "tb/crops  jpeg, " in lines[2]
    assert lines[3].endswith("drive:0 saw thing-0")
    (document,) = run("log", "cat", "log", "--from", "2", "--to", "3", "--json").lines
    assert (document["encoding"], document["schema"], document["payload"]) == ("jpeg", "", None)
    assert document["payload_base64"].startswith("/9j/")
    assert "/tf: 60 (cdr tf2_msgs/msg/TFMessage)" in run("log", "info", "log").out


def test_a_recording_for_foxglove_has_the_messages_on_their_topics(log_path: Path) -> None:
    write_mixed(log_path, 40)
    target = log_path.parent / "out.mcap"
    run = Commands.in_folder(log_path.parent)
    run("export", "log", "--foxglove", "out.mcap")
    topics = {"/tf": "/recorded/tf"}  # that of the mapped robot is there
    expected = [
        (topics.get(e.key, e.key), e.format.encoding, e.format.schema, e.payload)
        for e in mixed_events(40)
        if isinstance(e, VerbatimEvent)
    ]
    with target.open("rb") as file:
        seen = [
            (channel.topic, channel.message_encoding, "" if schema is None else schema.name, data)
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
            if channel.message_encoding in ("cdr", "jpeg") and (data := message.data) is not None
        ]
    assert sorted(seen) == sorted(expected)
    run("export", "log", "--foxglove", "again.mcap")
    assert (log_path.parent / "again.mcap").read_bytes() == target.read_bytes()


@pytest.mark.parametrize(
    ("topic", "form", "said"),
    [
        ("mapfold/command", TF, "mapfold's own"),
        ("/tf", TF._replace(schema_text=b"x" * 300_000), "more than 262,144"),
        ("/tf", TF._replace(encoding=""), "without topic or encoding"),
        ("", TF, "without topic or encoding"),
        ("/tf", TF._replace(schema=""), "without a name"),
        ("/t\ud800f", TF, "no name"),
        ("/tf", TF._replace(encoding="x" * 20_000), "no name"),
    ],
)
def test_a_message_that_no_segment_takes_is_refused(
    log_path: Path, topic: str, form: MessageFormat, said: str
) -> None:
    with LogWriter(log_path) as writer:
        with pytest.raises(LogError, match=said):
            writer.append(topic, b"x", form=form)
        writer.append("/tf", b"x", form=TF)
    assert len(read_log(log_path)) == 1


@pytest.mark.seconds
@pytest.mark.slow
def test_thousands_of_formats_and_large_schemas_stay_within_the_bounds(log_path: Path) -> None:
    """Schemas of 12 MB in all: a new segment begins before one has too many."""
    forms = [
        MessageFormat("cdr", f"p/msg/T{n}", "ros2msg", b"%06d" % n + b"#" * 200_000)
        for n in range(60)
    ]
    more = rounds(5000, 2500)
    with LogWriter(log_path, fsync=BY_HAND) as writer:
        writer.append_all([NewEvent("/t", b"x", n, n, format=f) for n, f in enumerate(forms)])
        writer.append_all([NewEvent(f"/t{n}", b"x", n, n, format=JPEG) for n in range(more)])
    events = read_log(log_path)
    assert [e.format for e in events[:60] if isinstance(e, VerbatimEvent)] == forms
    assert len(events) == 60 + more
    assert len(list_segments(log_path)) > 2
    for segment in list_segments(log_path):
        segment.path.write_bytes(segment.path.read_bytes()[:-100])  # all indexes rot
    recover_log(log_path)
    assert read_log(log_path) == events


def test_envelopes_and_messages_may_share_a_key(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        writer.append(KEY, envelope(0))
        writer.append(KEY, envelope(1), form=BOXES)
        writer.append(KEY, envelope(1))
    events = read_log(log_path)
    assert [event.is_envelope for event in events] == [True, False, True]
    assert isinstance(events[0], Event)
    assert verify_log(log_path).findings == ()
