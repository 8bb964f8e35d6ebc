"""A logger's record gives back what it received, byte for byte where the record still has it."""

import base64
import json

import pytest

from eventsrc.record.importers.json_lines import read_line
from eventsrc.record.importers.sources import ImportedMessage

TS_NS = 1740000000123000000
ODD = b'{ "run_id":"r\\u00e9", "n": 1e5, "n": 2,\t"x": 0.10, "s": "a\\"}, b" }'


def record(payload_text: bytes) -> bytes:
    return b'{"ts": 1740000000.123, "iso": "x", "key": "tb/d", "payload": %s}' % payload_text


def test_a_json_payload_is_cut_out_verbatim() -> None:
    assert read_line(record(ODD)) == ImportedMessage(ODD, "tb/d", TS_NS)


@pytest.mark.parametrize("tail", [b', "more": [1, {"payload": 2}]}', b"   }  ", b"}"])
def test_members_may_stand_in_any_order(tail: bytes) -> None:
    line = b' { "payload" : %s , "key":"k","ts":1740000000.123' % ODD + tail
    assert read_line(line) == ImportedMessage(ODD, "k", TS_NS)


def test_a_string_payload_is_its_text() -> None:
    line = record(json.dumps('{"run_id": "é🙂"}').encode())
    assert read_line(line).payload == '{"run_id": "é🙂"}'.encode()
    assert read_line(record(b'"not json"')).payload == b"not json"


def test_a_string_of_base64_is_decoded_when_json_is_in_it() -> None:
    text = json.dumps(base64.b64encode(ODD).decode()).encode()
    assert read_line(record(text)).payload == ODD
    assert read_line(record(b'"abcd"')).payload == b"abcd"


def test_the_older_logger_kept_bare_lists() -> None:
    line = b'{"ts": 1740000000.123, "iso": "x", "detections": [{"class":  "cup"}]}'
    assert read_line(line) == ImportedMessage(b'[{"class":  "cup"}]', None, TS_NS)


@pytest.mark.parametrize(
    "line",
    [
        b'{"run_id": "r", "ts": 1, "detections": []}',
        b'{"ts": 1, "payload": ',
        b'{"ts" 1, "payload": 2}',
        b'{"ts": 1}',
        b'["ts", "payload"]',
        b'{"payload": {}, "key": "no time"}',
        b'\xff{"ts": 1, "payload": 2}',
        b"plain",
    ],
)
def test_any_other_line_is_the_message_itself(line: bytes) -> None:
    assert read_line(line) == ImportedMessage(line)


@pytest.mark.parametrize("ts", [b'"soon"', b"null", b"-1", b"1e99", b"NaN", b"Infinity"])
def test_an_invalid_time_is_left_out(ts: bytes) -> None:
    line = b'{"ts": %s, "key": "k", "payload": {}}' % ts
    assert read_line(line) == ImportedMessage(b"{}", "k", None)
