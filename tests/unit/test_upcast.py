"""Payloads of older versions are recorded verbatim and read as current envelopes."""

import json
from pathlib import Path

import pytest

from eventsrc.append import append_payload
from eventsrc.envelope import ENVELOPE_VERSION, Envelope
from eventsrc.ingest import Accepted, Rejected
from eventsrc.log import Event, LogReader, LogWriter
from eventsrc.log.format import ENVELOPE_VERSION_KEY, envelope_version, key_channel
from eventsrc.upcast import UPCASTERS, detect_version, read_envelope
from projections.model.fold import fold_log
from projections.settings import Settings
from tests.fixtures_log import KEY, envelope, read_log

BARE = json.dumps(
    [
        {"class_name": "cup", "confidence": 0.9, "bbox": [1.0, 2.0, 3.0, 4.0]},
        {"class": "chair", "confidence": 0.5, "bbox": [1.0, 2.0, 3.0, 4.0], "track": 7},
    ]
).encode()


def event(payload: bytes, version: int) -> Event:
    return Event(17, KEY, 3_000_000_000, 2_500_000_000, payload, version)


def test_a_bare_list_becomes_an_envelope_of_its_event() -> None:
    read = read_envelope(event(BARE, 1))
    assert isinstance(read, Accepted)
    assert (read.envelope.run_id, read.envelope.keyframe_id) == (f"unnamed:{KEY}", 17)
    assert read.envelope.timestamp == 2.5
    assert read.envelope.map_x is None
    assert [d.class_name for d in read.envelope.detections] == ["cup", "chair"]


@pytest.mark.parametrize(
    "payload", [b"{}", b"[1]", b"[{}", b'[{"class": 1}]', b"[" * 100_000, b"\xff", b"null"]
)
def test_what_is_no_bare_list_is_refused_with_a_reason(payload: bytes) -> None:
    read = read_envelope(event(payload, 1))
    assert isinstance(read, Rejected)
    assert read.reason


def test_an_unknown_version_is_named() -> None:
    read = read_envelope(event(envelope(1), ENVELOPE_VERSION + 1))
    assert isinstance(read, Rejected)
    assert "upgrade" in read.reason


def test_there_is_an_upcaster_for_every_older_version() -> None:
    assert sorted(UPCASTERS) == list(range(1, ENVELOPE_VERSION))


@pytest.mark.parametrize(
    ("payload", "version"),
    [(BARE, 1), (b' \n[ {"class"', 1), (b"[1]", 2), (b"[]", 2), (b"{}", 2), (b"", 2)],
)
def test_the_version_is_detected_from_the_payload(payload: bytes, version: int) -> None:
    assert detect_version(payload) == version


def test_a_log_of_both_forms_keeps_the_bytes_and_folds(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        assert isinstance(append_payload(writer, KEY, envelope(1)), Envelope)
        assert isinstance(append_payload(writer, KEY, BARE, logged_ns=10**9), Envelope)
        assert isinstance(append_payload(writer, KEY, b'[{"class": "cup"}]'), Rejected)
    events = read_log(log_path)
    assert [e.version for e in events[:2]] == [2, 1]
    assert events[1].payload == BARE
    assert events[2].key == "mapfold/rejected"
    with LogReader(log_path) as reader:
        _, view = fold_log(reader, Settings())
    counts = view.counts()
    assert (counts["keyframes"], counts["observations"], counts["places"]) == (2, 2, 0)


@pytest.mark.parametrize("said", ["", "two", "\x00", "-1", "9" * 5_000])
def test_a_channel_of_an_invalid_version_stops_no_reader(said: str) -> None:
    channel = key_channel(1, 1, KEY, ENVELOPE_VERSION)
    channel.metadata[ENVELOPE_VERSION_KEY] = said
    assert isinstance(read_envelope(event(envelope(1), envelope_version(channel))), Rejected)
