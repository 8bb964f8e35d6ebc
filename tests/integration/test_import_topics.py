"""What of a file is imported, by topic, and what is passed over."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from eventsrc.envelope.system_events import REJECTED_KEY
from eventsrc.log import Event, LogWriter
from eventsrc.record.importers.sources import TopicChoice, looks_like_envelope
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log
from tests.support.logs import mixed_event

ODOMETRY = {"header": {"frame_id": "odom"}, "pose": {"x": 1.0}, "timestamp": 3.0}
BARE = [{"class_name": "cup", "confidence": 0.5, "bbox": [0, 0, 1, 1]}]


def write_mcap(path: Path, messages: list[tuple[str, str, bytes]]) -> None:
    """Topic, message encoding and payload of each."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[tuple[str, str], int] = {}
        for number, (topic, encoding, data) in enumerate(messages):
            if (topic, encoding) not in channels:
                schema = writer.register_schema(f"of/{encoding}", "x", b"")
                channels[topic, encoding] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic, encoding], 1000 + number, data, number)
        writer.finish()


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Beside an MCAP file with envelopes among other messages."""
    run = Commands.in_folder(tmp_path)
    messages = [("tb/detections", "json", payload(envelope(k))) for k in range(3)]
    messages += [("/odom", "json", payload(ODOMETRY))] * 5
    messages += [("/camera", "cdr", b"\x00\x01\x00\x00image")] * 2
    messages += [("tb/other", "json", payload({**envelope(7), "map_x": "east"}))]
    messages += [("/numbers", "json", b"[1, 2]"), ("/numbers", "json", b"7")]
    write_mcap(tmp_path / "a.mcap", messages)
    return run


def keys_of(run: Commands, log: str = "L") -> list[str]:
    return [event.key for event in read_log(run.folder / log)]


def test_topics_that_are_not_envelopes_are_passed_over_with_a_count(run: Commands) -> None:
    said = run("import", "L", "a.mcap", code=3)
    assert keys_of(run) == ["tb/detections"] * 3 + [REJECTED_KEY]
    assert "9 messages passed over, 1 rejected; " in said.err
    assert [line for line in said.err.splitlines() if line.startswith("passed over")] == [
        "passed over: /odom: 5 messages, json, no envelopes",
        "passed over: /camera: 2 messages, cdr of/cdr",
        "passed over: /numbers: 2 messages, json, no envelopes",
    ]
    report = run("import", "M", "a.mcap", "--json", code=3).json
    assert (report["accepted"], report["rejected"], report["skipped"]) == (3, 1, 9)
    assert report["passed_over"][0] == {
        "topic": "/odom",
        "what": "json, no envelopes",
        "count": 5,
    }


@pytest.mark.parametrize(
    ("topics", "kept", "code"),
    [
        (["tb/detections"], ["tb/detections"] * 3, 0),
        (["tb/d*"], ["tb/detections"] * 3, 0),
        (["*det*ions"], ["tb/detections"] * 3, 0),
        (["tb/*"], ["tb/detections"] * 3 + [REJECTED_KEY], 3),
        (["/odom", "tb/d*"], ["tb/detections"] * 3 + [REJECTED_KEY] * 5, 3),
        (["/od[a-z]m"], [REJECTED_KEY] * 5, 3),
        (["/camera"], [], 3),
        (["tb"], [], 3),
        (["TB/*"], [], 3),
    ],
)
def test_topics_are_chosen_by_pattern(
    run: Commands, topics: list[str], kept: list[str], code: int
) -> None:
    """Of a chosen topic each message that is no envelope is kept as rejected."""
    options = [part for topic in topics for part in ("--topic", topic)]
    said = run("import", "L", "a.mcap", *options, code=code)
    assert keys_of(run) == kept
    assert ("nothing was imported" in said.err) == (not kept)


def test_nothing_out_of_something_is_a_finding_and_nothing_out_of_nothing_is_none(
    run: Commands,
) -> None:
    write_mcap(run.folder / "odom.mcap", [("/odom", "json", payload(ODOMETRY))])
    said = run("import", "L", "odom.mcap", code=3)
    assert "imported 0 envelopes into L, 1 message passed over, 0 rejected\n" in said.err
    assert "nothing was imported: no message is an envelope" in said.err
    said = run("import", "L", "a.mcap", "--topic", "nowhere/*", code=3)
    assert "nothing was imported: --topic chooses none of these topics" in said.err
    write_mcap(run.folder / "empty.mcap", [])
    assert "nothing was imported" not in run("import", "L", "empty.mcap").err
    run("import", "L", "-", stdin=b"\n\n")
    said = run("import", "L", "-", "--topic", "", stdin=b"", code=2)
    assert "--topic is empty; give a topic, or a pattern such as 'tb/*'" in said.err


def test_keys_of_logger_records_and_of_logs_are_topics_too(run: Commands) -> None:
    records = [{"ts": k, "key": f"robot{k}/seen", "payload": envelope(k)} for k in range(3)]
    lines = b"\n".join([*map(payload, records), payload(envelope(9))])
    run("import", "L", "-", "--topic", "robot[12]/*", stdin=lines)
    assert keys_of(run) == ["robot1/seen", "robot2/seen"]
    run("import", "M", "L", "--topic", "*2/seen")
    assert keys_of(run, "M") == ["robot2/seen"]
    run("import", "N", "-", "--key", "mine", "--topic", "mine", stdin=lines)
    assert keys_of(run, "N") == ["mine"]


def test_a_segment_of_a_log_is_never_judged_by_its_looks(run: Commands) -> None:
    with LogWriter(run.folder / "L") as writer:
        writer.append("tb/detections", payload(ODOMETRY))
    run("import", "M", *map(str, (run.folder / "L").glob("*.mcap")), code=3)
    assert keys_of(run, "M") == [REJECTED_KEY]


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        (envelope(1), True),
        ({"run_id": "a", "detections": []}, True),
        (ODOMETRY, False),
        ({"header": {}, "detections": []}, False),
        ({}, False),
        (BARE, True),
        ([], True),
        ([{"x": 1}], False),
        ([BARE], False),
        ("text", False),
        (None, False),
    ],
)
def test_what_is_meant_as_an_envelope(document: Any, expected: bool) -> None:
    assert looks_like_envelope(payload(document)) is expected


@given(st.binary(max_size=60))
def test_bytes_that_are_no_json_may_be_a_torn_envelope(data: bytes) -> None:
    try:
        json.loads(data)
    except ValueError:
        assert looks_like_envelope(data)
    assert looks_like_envelope(b"[" * 100_000)


def test_a_choice_without_patterns_takes_every_topic() -> None:
    assert not TopicChoice()
    assert TopicChoice().takes("anything")
    assert not TopicChoice.of(["a?"]).takes("a")


def test_an_empty_list_says_why_it_is_nothing(run: Commands) -> None:
    said = run("import", "L", "-", stdin=b"[]\n[ ]\n" + payload(envelope(1)), code=3)
    assert "line 1: rejected: an empty list: of the older form without an envelope" in said.err
    assert said.err.count("names no run, keyframe, time or pose") == 2
    assert "not a JSON object but list" in run("import", "L", "-", stdin=b"[1]", code=3).err


def shown_again(run: Commands, log: str, other: str, *options: str, code: int = 0) -> str:
    """What `log cat --json` shows of ``log``, imported into ``other``; what the import says."""
    shown = run("log", "cat", log, "--json", *options).out
    return run("import", other, "-", stdin=shown.encode(), code=code).err


def as_values(event: Event) -> tuple[Any, ...]:
    value = json.loads(event.payload)
    return event.key, event.logged_ns, event.stamp_ns, event.version, value


def test_what_log_cat_shows_is_imported_as_it_was(run: Commands) -> None:
    lines = [payload(envelope(k, float(k), detections=[])) for k in range(3)]
    lines += [payload(BARE), b"junk \xff", b'"text"', b'{"run_id": 1}']
    lines += [payload({"ts": 5.5, "key": "k", "payload": {**envelope(9), "logged_ns": 1}})]
    run("import", "L", "-", stdin=b"\n".join(lines), code=3)
    shown_again(run, "L", "M")
    before, after = read_log(run.folder / "L"), read_log(run.folder / "M")
    assert list(map(as_values, after)) == list(map(as_values, before))
    shown_again(run, "L", "N", "--from", "1", "--to", "3")
    assert [e.payload for e in read_log(run.folder / "N")] == lines[1:3]


def test_a_bare_list_keeps_its_version_and_verbatim_messages_are_passed_over(
    run: Commands,
) -> None:
    bare = payload([{"class_name": "cup", "confidence": 0.5, "bbox": [0.0, 0.0, 4.0, 4.0]}])
    with LogWriter(run.folder / "L") as writer:
        writer.append("tb/detections", bare, logged_ns=5, stamp_ns=5, version=1)
        writer.append_all([mixed_event(0), mixed_event(2)])
    said = shown_again(run, "L", "M")
    (event,) = read_log(run.folder / "M")
    assert (event.version, event.logged_ns, json.loads(event.payload)) == (1, 5, json.loads(bare))
    assert "passed over: /tf: 1 message, cdr tf2_msgs/msg/TFMessage, without the schema's" in said


DAMAGES: list[dict[str, Any]] = [
    {"logged_ns": -1},
    {"logged_ns": 2**63},
    {"stamp_ns": 1.5},
    {"stamp_ns": True},
    {"key": ""},
    {"key": None},
    {"payload": None, "payload_base64": "no base64"},
]


def test_a_line_of_log_cat_with_a_wrong_field_is_rejected_whole(run: Commands) -> None:
    line = {"offset": 0, "logged_ns": 1, "stamp_ns": 2, "key": "k", "payload": envelope(1)}
    lines = [payload({**line, **damage}) for damage in DAMAGES]
    run("import", "L", "-", stdin=payload(line))
    run("import", "L", "-", stdin=lines[0], code=3)
    assert keys_of(run) == ["k", REJECTED_KEY]
    run("import", "L", "-", stdin=b"\n".join(lines[1:]), code=3)
    assert keys_of(run) == ["k", *[REJECTED_KEY] * len(DAMAGES)]


def test_an_envelope_with_fields_of_that_name_is_an_envelope(run: Commands) -> None:
    names = {"offset": 0, "logged_ns": 1, "stamp_ns": 2, "key": "k", "payload": {}}
    document = payload({**envelope(1), **names})
    run("import", "L", "-", stdin=document)
    (event,) = read_log(run.folder / "L")
    assert (event.key, event.payload) == ("tb/detections", document)
