"""What one message may cost, whatever is in it: a 16 MiB message is judged and kept in bounded work
and memory."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.forms import PendingEvent, read_envelope
from eventsrc.envelope.ingest import MAX_JSON_VALUES, Accepted, Rejected, ingest
from eventsrc.envelope.model import MAX_DETECTIONS
from tests.support.envelopes import detection, envelope, payload
from tests.support.thorough import mostly_slow

CPU_S = 60
"""For all shapes together; they take about five. The slowest alone took longer before."""
PEAK_MB = 300

HOSTILE = r"""
import re, resource, sys
from pathlib import Path
from eventsrc.record.append import append_payload
from eventsrc.log import LogWriter
from eventsrc.envelope.ingest import MAX_JSON_VALUES

resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[2]), int(sys.argv[2])))
SIZE = int(sys.argv[3]) << 20
HEAD = b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":'
VALID = b'{"class":"a","confidence":1,"bbox":[0,0,0,0]}'

def shapes():
    for most in (SIZE, MAX_JSON_VALUES - 100):  # as many as fit, as many as are read

        def many(start, unit, end):
            marks = 1 + sum(map(unit.count, (b",", b"[", b"{")))
            count = min((SIZE - len(start) - len(end)) // (len(unit) + 1), most // marks)
            return b"".join((start, (unit + b",") * (count - 1), unit, end))

        def named(start, value, end):
            marks = 1 + sum(map(value.count, (b",", b"[", b"{")))
            count = min((SIZE - len(start) - len(end)) // (len(value) + 12), most // marks)
            made = bytearray(start)
            for n in range(count):
                made += b'"%08d":%s,' % (n, value)
            made[-1:] = end
            return bytes(made)

        yield many(HEAD + b"[", b"{}", b"]}")
        yield many(HEAD + b"[", VALID, b"]}")
        yield many(HEAD + b"[", VALID, b",{}]}")
        yield many(HEAD + b'[],"u":[', b"1", b"]}")
        yield many(HEAD + b'[],"u":[', b"NaN", b"]}")
        yield many(HEAD + b'[],"u":[', b"[" * 150 + b"]" * 150, b"]}")
        yield many(HEAD + b'[],"u":[', b"9" * 4200, b"]}")
        yield many(HEAD + b'[{"class":"a","confidence":1,"bbox":[', b"[]", b"]}]}")
        yield many(b'{"u":[', b"{}", b"]}")
        yield many(b"[", b"{}", b"]")
        yield many(b'[{"a":[', b"1", b"]}]")
        yield named(HEAD + b"[],", b"1", b"}")
        yield named(HEAD + b"[],", b"NaN", b"}")
        yield named(HEAD + b"[" + VALID[:-1] + b",", b"NaN", b"}]}")
        yield named(b"[{", b"1", b"}]")
    yield b'{"run_id":"' + b"x" * (SIZE - 64) + b'","keyframe_id":1,"timestamp":1,"detections":[]}'
    yield HEAD + b'[],"u":' + b"9" * (SIZE - 80) + b"}"
    yield HEAD + b'[],"' + b"n" * (SIZE - 80) + b'":NaN}'
    yield HEAD + b'[],"u":"' + b"x" * (SIZE - 80) + b'\xff"}'
    yield b"[" * SIZE

def peak_kb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

with LogWriter(Path(sys.argv[1])) as log:
    append_payload(log, "k", HEAD + b"[]}")
    before = peak_kb()
    for shape in shapes():
        assert len(shape) <= SIZE + 100
        said = append_payload(log, "k", shape)
        assert len(getattr(said, "reason", "")) < 400, said.reason[:1000]
    print((peak_kb() - before) // 1024, log.next_offset)
"""


@pytest.mark.parametrize("mib", mostly_slow([1, 16]))
@pytest.mark.seconds
@pytest.mark.slow
def test_a_large_message_of_any_content_costs_little(tmp_path: Path, mib: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", HOSTILE, str(tmp_path / "log"), str(CPU_S), str(mib)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    peak_mb, kept = map(int, done.stdout.split())
    assert kept == 1 + 2 * 15 + 5
    assert peak_mb <= PEAK_MB


def reason(document: Any) -> str:
    said = ingest(document if isinstance(document, bytes) else payload(document))
    assert isinstance(said, Rejected)
    return said.reason


def test_parsing_stops_at_the_first_bad_detection() -> None:
    """`and 2 more` are those of this detection, not the thousands behind it."""
    broken = envelope(detections=[{}] * 5_000)
    assert reason(broken) == "detections.0.class: required field is missing (and 2 more)"


def test_parsing_stops_at_the_first_non_finite_unknown_field() -> None:
    odd = {f"f{n}": float("nan") for n in range(5_000)}
    assert reason(envelope(**odd)) == "f0: holds NaN or infinity (got nan)"
    assert reason(odd) == "f0: holds NaN or infinity (got nan)"
    assert reason({**odd, "detections": 7}) == "f0: holds NaN or infinity (got nan)"


def test_the_last_of_a_repeated_field_counts() -> None:
    assert isinstance(ingest(payload(envelope())[:-1] + b',"u":NaN,"u":1}'), Accepted)
    assert reason(payload(envelope())[:-1] + b',"u":1,"u":NaN}').startswith("u: holds NaN")
    assert reason(payload(envelope())[:-1] + b',"run_id":"x","run_id":2}').endswith("(got 2)")


def test_the_number_of_detections_is_bounded() -> None:
    most = [detection()] * MAX_DETECTIONS
    assert isinstance(ingest(payload(envelope(detections=most))), Accepted)
    assert reason(envelope(detections=[*most, detection()])).startswith(
        f"detections: Tuple should have at most {MAX_DETECTIONS} items"
    )


def test_the_number_of_json_values_is_bounded() -> None:
    image = [0] * (MAX_JSON_VALUES - 100)
    assert isinstance(ingest(payload(envelope(depth=image))), Accepted)
    assert reason(envelope(depth=[*image, *[0] * 101])).endswith(
        "commas and opening brackets, more than 500,000"
    )


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("x" * 100_000, "'" + "x" * 76 + "..."),
        ([[{"a": "x" * 100}]] * 1_000, "[[{'a': '" + "x" * 68 + "..."),
        ({"a": [1, None, True, 0.5], "b": {}}, "{'a': [1, None, True, 0.5], 'b': {}}"),
        ([], "[]"),
    ],
    ids=["text", "nested", "small", "empty"],
)
def test_a_reason_shows_the_start_of_a_wrong_value(value: Any, shown: str) -> None:
    assert reason(envelope(timestamp=value)).endswith(f"(got {shown})")


def test_a_reason_escapes_control_characters() -> None:
    said = reason(envelope(detections=[detection(**{"\x1b]0;x\x07\u202e": float("inf")})]))
    assert said.startswith(r"detections.0.\x1b]0;x\x07\u202e: holds NaN or infinity")


def test_a_bare_list_is_bounded_too() -> None:
    def said(detections: list[dict[str, Any]]) -> str:
        event = PendingEvent(0, "tb/detections", 0, json.dumps(detections).encode(), version=1)
        outcome = read_envelope(event)
        assert isinstance(outcome, Rejected)
        return outcome.reason

    assert said([{}] * (MAX_DETECTIONS + 1)).endswith("10001 detections, more than 10000")
    assert said([{"a": [0] * MAX_JSON_VALUES}]).endswith("opening brackets, more than 500,000")
    assert said([{"a": float("nan")}]).endswith("holds NaN or infinity")
