"""Bare lists are recorded verbatim and read as envelopes; other versions are refused."""

import json
from pathlib import Path

import pytest

from eventsrc.envelope.forms import detect_version, read_envelope
from eventsrc.envelope.ingest import Accepted, CheckedEnvelope, Rejected
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.log import Event, LogReader, LogWriter
from eventsrc.log.channels import ENVELOPE_VERSION_KEY, envelope_version, key_channel
from eventsrc.log.verify import verify_log
from eventsrc.record.append import append_payload
from eventsrc.record.importers.run import import_files
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from tests.support.fixtures_log import KEY, envelope, read_log

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


def test_a_list_of_envelopes_is_refused_as_such() -> None:
    payload = b"[" + envelope(1) + b"," + envelope(2) + b"]"
    assert detect_version(payload) == 1
    read = read_envelope(event(payload, 1))
    assert isinstance(read, Rejected)
    assert read.reason.startswith("a list of envelopes; each must be a message")


def test_an_unknown_version_is_named() -> None:
    read = read_envelope(event(envelope(1), ENVELOPE_VERSION + 1))
    assert isinstance(read, Rejected)
    assert "upgrade" in read.reason


@pytest.mark.parametrize("version", [2, 3, 4])
def test_a_version_that_was_never_released_is_refused_and_imported(
    tmp_path: Path, version: int
) -> None:
    with LogWriter(tmp_path / "old") as writer:
        writer.append(KEY, envelope(1), logged_ns=5, stamp_ns=10**9, version=version)
    (old,) = read_log(tmp_path / "old")
    read = read_envelope(old)
    assert isinstance(read, Rejected)
    assert read.reason == (
        f"envelope version {version} was never released; import the log into a new one, which "
        "reads it as version 5"
    )
    (finding,) = verify_log(tmp_path / "old").findings
    assert (finding.kind, read.reason in finding.message) == ("schema", True)
    (segment,) = (tmp_path / "old").glob("*.mcap")
    for source in (tmp_path / "old", segment):
        with LogWriter(tmp_path / source.name / "new") as writer:
            assert import_files(writer, [str(source)]).accepted == 1
        (new,) = read_log(tmp_path / source.name / "new")
        assert (new.version, new.payload, new.logged_ns) == (ENVELOPE_VERSION, old.payload, 5)
        assert isinstance(read_envelope(new), Accepted)


@pytest.mark.parametrize(
    ("payload", "version"),
    [(BARE, 1), (b' \n[ {"class"', 1), (b"[1]", 5), (b"[]", 5), (b"{}", 5), (b"", 5)],
)
def test_the_version_is_detected_from_the_payload(payload: bytes, version: int) -> None:
    assert detect_version(payload) == version


def test_a_log_of_both_forms_keeps_the_bytes_and_folds(log_path: Path) -> None:
    with LogWriter(log_path) as writer:
        assert isinstance(append_payload(writer, KEY, envelope(1)), CheckedEnvelope)
        assert isinstance(append_payload(writer, KEY, BARE, logged_ns=10**9), CheckedEnvelope)
        assert isinstance(append_payload(writer, KEY, b'[{"class": "cup"}]'), Rejected)
    events = read_log(log_path)
    assert [e.version for e in events[:2]] == [ENVELOPE_VERSION, 1]
    assert events[1].payload == BARE
    assert events[2].key == "mapfold/rejected"
    with LogReader(log_path) as reader:
        _, view = fold_log(reader, Settings())
    counts = view.counts()
    assert (counts["keyframes"], counts["observations"], counts["places"]) == (2, 2, 0)


def test_fields_of_a_bare_list_that_envelopes_define_otherwise_are_ignored() -> None:
    cup = {"class": "cup", "confidence": 0.5, "bbox": [1.0, 2.0, 3.0, 4.0]}
    more = {"position": {"x": 1.0}, "depth_m": "far", "depth_sigma_m": -1, "track": [7]}
    read = read_envelope(event(json.dumps([cup | more]).encode(), 1))
    assert isinstance(read, Accepted)
    (found,) = read.envelope.detections
    assert (found.class_name, found.depth_m, found.position) == ("cup", None, None)


@pytest.mark.parametrize("said", ["", "two", "\x00", "-1", "9" * 5_000])
def test_a_channel_of_an_invalid_version_stops_no_reader(said: str) -> None:
    channel = key_channel(1, 1, KEY, ENVELOPE_VERSION)
    channel.metadata[ENVELOPE_VERSION_KEY] = said
    assert isinstance(read_envelope(event(envelope(1), envelope_version(channel))), Rejected)
