"""Payloads of older versions are recorded verbatim and read as current envelopes."""

import json
from pathlib import Path

import pytest

from eventsrc.envelope.ingest import Accepted, CheckedEnvelope, Rejected, ingest
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.envelope.upcast import UPCASTERS, detect_version, read_envelope
from eventsrc.log import Event, LogReader, LogWriter
from eventsrc.log.format import ENVELOPE_VERSION_KEY, envelope_version, key_channel
from eventsrc.log.verify import verify_log
from eventsrc.record.append import append_payload
from eventsrc.record.gap_history import fold_and_save_ledger
from eventsrc.record.importers.run import import_files
from projections.fold.settings import Settings
from projections.map.fold import fold_log
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


def test_there_is_an_upcaster_for_every_older_version() -> None:
    assert sorted(UPCASTERS) == list(range(1, ENVELOPE_VERSION))


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


OLDER = {
    "camera": "front",
    "position": [0.1, "left"],
    "detections": [
        {
            "class": "cup",
            "confidence": 0.5,
            "bbox": [1.0, 2.0, 3.0, 4.0],
            "position": {"x": 1.0},
            "depth_m": "far",
            "depth_sigma_m": -1,
            "position_sigma_m": None,
            "track": [7],
        }
    ],
}


def test_unknown_fields_of_version_2_with_names_of_version_3_are_dropped() -> None:
    payload = envelope(1, **OLDER)
    assert isinstance(read_envelope(event(payload, 3)), Rejected)
    for version in (2, 1):
        body = payload if version == 2 else json.dumps(OLDER["detections"]).encode()
        read = read_envelope(event(body, version))
        assert isinstance(read, Accepted)
        assert read.envelope.camera is None
        (cup,) = read.envelope.detections
        assert (cup.class_name, cup.depth_m, cup.position) == ("cup", None, None)
    fits = envelope(1, camera={"hfov_deg": 90.0, "width_px": 640.0, "height_px": 480.0})
    read = read_envelope(event(fits, 2))
    assert isinstance(read, Accepted)
    assert read.envelope.camera is None, "its writer did not mean our field"
    younger = read_envelope(event(fits, 3))
    assert isinstance(younger, Accepted)
    assert younger.envelope.camera is not None


def test_fields_of_version_3_with_names_of_version_4_are_dropped() -> None:
    for more in ({"floor": 2, "map_z": 1.0}, {"floor": {"of": "ours"}, "map_z": "high"}):
        old = read_envelope(event(envelope(1, **more), 3))
        assert isinstance(old, Accepted)
        assert (old.envelope.floor, old.envelope.map_z) == (None, None)
    new = read_envelope(event(envelope(1, floor=2, map_z=1.0), 4))
    assert isinstance(new, Accepted)
    assert (new.envelope.floor, new.envelope.map_z) == ("2", 1.0)


def test_a_field_of_version_4_with_the_name_of_one_of_version_5_is_dropped() -> None:
    nine = [0.04, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.01]
    for value in (nine, "unknown", [1.0]):
        old = read_envelope(event(envelope(1, pose_covariance=value, floor=2), 4))
        assert isinstance(old, Accepted)
        assert (old.envelope.pose_covariance, old.envelope.floor) == (None, "2")
    new = read_envelope(event(envelope(1, pose_covariance=nine), 5))
    assert isinstance(new, Accepted)
    assert new.envelope.pose_covariance == tuple(nine)
    assert isinstance(read_envelope(event(envelope(1, pose_covariance=[1.0]), 5)), Rejected)


def test_a_faulty_envelope_of_version_2_is_refused_with_its_own_fault() -> None:
    for body in (b"{", b"[1]", b'{"run_id": 1}', b'{"camera": ' + b"[" * 9_999):
        read = read_envelope(event(body, 2))
        assert read == ingest(body)
        assert isinstance(read, Rejected)
    read = read_envelope(event(envelope(1, **{**OLDER, "map_x": "east"}), 2))
    assert isinstance(read, Rejected)
    assert read.reason.startswith("map_x: ")


def test_a_log_of_version_2_reads_verifies_and_is_imported_as_it_was(tmp_path: Path) -> None:
    payloads = [envelope(number, **OLDER) for number in (1, 2, 4)]
    with LogWriter(tmp_path / "old") as writer:
        for number, payload in enumerate(payloads):
            writer.append(KEY, payload, stamp_ns=10**9 * number, version=2)
    with LogWriter(tmp_path / "new") as writer:
        report = import_files(writer, [str(tmp_path / "old")])
        assert (report.accepted, report.rejected) == (3, 0)
        (segment,) = (tmp_path / "old").glob("*.mcap")
        report = import_files(writer, [str(segment)])
        assert (report.accepted, report.rejected) == (3, 0)
    for name in ("old", "new"):
        events = [e for e in read_log(tmp_path / name) if e.key == KEY]
        assert {e.version for e in events} == {2}
        assert [e.payload for e in events[:3]] == payloads
        with LogReader(tmp_path / name) as reader:
            _, view = fold_log(reader, Settings())
            findings = {f.kind for f in verify_log(tmp_path / name).findings}
            ledger = fold_and_save_ledger(reader)
        assert view.counts()["observations"] == 3
        assert "schema" not in findings
        assert ("duplicate" in findings) is (name == "new"), "its keyframes are counted"
        assert [(gap.first, gap.last) for gap in ledger.gaps()] == [(3, 3)]


@pytest.mark.parametrize("said", ["", "two", "\x00", "-1", "9" * 5_000])
def test_a_channel_of_an_invalid_version_stops_no_reader(said: str) -> None:
    channel = key_channel(1, 1, KEY, ENVELOPE_VERSION)
    channel.metadata[ENVELOPE_VERSION_KEY] = said
    assert isinstance(read_envelope(event(envelope(1), envelope_version(channel))), Rejected)
