"""What a log that drops classes stores of an envelope, of crops and of refused payloads."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.dropped_classes import HELD_CROPS, ClassDropper, Stripped
from eventsrc.envelope.forms import BARE_LIST_VERSION
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.envelope.model import ENVELOPE_VERSION, DetId
from eventsrc.envelope.system_events import Excerpt, RejectedPayload
from tests.support.envelopes import detection, envelope, payload

CLASSES = st.sampled_from(["person", "cup", "Person", "chair"])


def stripped(document: Any, *classes: str, labels: dict[str, str] | None = None) -> Stripped:
    return ClassDropper[None](classes, labels or {}).strip(payload(document), ENVELOPE_VERSION)


def test_the_others_stay_as_they_were_with_the_ids_that_they_had() -> None:
    seen = [detection("person", [1.0, 2.0]), detection("cup", [3.0, 4.0]), detection("chair")]
    seen[2]["det_id"] = "mine"
    seen[2]["colour"] = {"of": ["unknown", "fields"]}
    before = envelope(7, detections=seen, note="a robot's own field")
    found = stripped(before, "person")
    after = json.loads(found.payload)
    assert after == {
        **before,
        "dropped_detections": 1,
        "detections": [{**seen[1], "det_id": "run-a_kf7_d1"}, seen[2]],
    }
    assert found[1:] == (("run-a_kf7_d1", "mine"), ("run-a_kf7_d0",))


def test_an_envelope_without_them_keeps_its_bytes() -> None:
    raw = payload(envelope(1, detections=[detection("cup")]))
    assert ClassDropper[None](["person"]).strip(raw, ENVELOPE_VERSION).payload == raw


def test_a_class_by_its_other_name_its_label_or_written_in_escapes_is_left_out_too() -> None:
    other = detection("cup")
    other["class_name"] = "person"
    assert json.loads(stripped(envelope(detections=[other]), "person").payload)["detections"] == []
    numbered = envelope(detections=[detection("0"), detection("1")])
    found = json.loads(stripped(numbered, "person", labels={"0": "person", "1": "cup"}).payload)
    assert [each["class"] for each in found["detections"]] == ["1"]
    escaped = payload(envelope(detections=[detection("person")])).replace(
        b"person", b"p\\u0065rson"
    )
    dropper = ClassDropper[None](["person"])
    assert b"rson" not in dropper.strip(escaped, ENVELOPE_VERSION).payload


def test_what_was_dropped_before_is_counted_too() -> None:
    once = stripped(envelope(detections=[detection("person"), detection("cup")]), "person")
    twice = ClassDropper[None](["cup"]).strip(once.payload, ENVELOPE_VERSION)
    assert json.loads(twice.payload)["dropped_detections"] == 2


def test_a_bare_list_is_stored_without_them() -> None:
    bare = [
        {"class_name": name, "confidence": 1.0, "bbox": [0, 0, 1, 1]} for name in ("person", "a")
    ]
    dropper = ClassDropper[None](["person"])
    assert json.loads(dropper.strip(payload(bare), BARE_LIST_VERSION).payload) == bare[1:]
    assert dropper.counts == (1, 0)


@given(
    st.lists(CLASSES, max_size=6),
    st.frozensets(CLASSES, max_size=2),
    st.lists(st.booleans(), min_size=6),
)
def test_detections_of_other_classes_are_read_as_before(
    names: list[str], classes: frozenset[str], named: list[bool]
) -> None:
    """Ids, vectors and all: as if the others had been left out of what was read."""
    seen = [
        detection(name, [float(i), 1.0], **({"det_id": f"own-{i}"} if named[i] else {}))
        for i, name in enumerate(names)
    ]
    before = ingest(payload(envelope(detections=seen)))
    after = ingest(stripped(envelope(detections=seen), *classes).payload)
    assert isinstance(before, Accepted)
    assert isinstance(after, Accepted)
    left = [i for i, name in enumerate(names) if name not in classes]
    assert after.det_ids == tuple(before.det_ids[i] for i in left)
    for at, i in enumerate(left):
        one, other = after.vectors[at], before.vectors[i]
        assert one is not None
        assert other is not None
        assert one.tobytes() == other.tobytes()


class TestCrops:
    def dropper(self) -> ClassDropper[str]:
        return ClassDropper(["person"])

    def test_a_crop_waits_for_the_envelope_with_its_detection(self) -> None:
        dropper = self.dropper()
        assert [dropper.crop(each, each, 10) for each in "abc"] == [[], [], []]
        assert dropper.release(Stripped(b"", (DetId("a"),), (DetId("b"),))) == ["a"]
        assert dropper.crop("a", "again", 10) == ["again"]
        assert dropper.crop("b", "again", 10) == []
        assert dropper.counts == (0, 3)  # b twice, and c, whose envelope has not come

    def test_an_id_that_was_dropped_once_gets_no_crop(self) -> None:
        dropper = self.dropper()
        dropper.release(Stripped(b"", (DetId("a"),)))
        dropper.release(Stripped(b"", (), (DetId("a"),)))
        assert dropper.crop("a", "a", 10) == []

    def test_few_wait(self) -> None:
        dropper = self.dropper()
        for number in range(HELD_CROPS + 5):
            dropper.crop(str(number), str(number), 10)
        assert dropper.release(Stripped(b"", (DetId("4"),))) == []
        assert dropper.release(Stripped(b"", (DetId("5"),))) == ["5"]
        dropper.crop("large", "large", 2**30)
        assert dropper.release(Stripped(b"", (DetId("6"), DetId("large")))) == []
        assert dropper.counts == (0, HELD_CROPS + 5)

    def test_without_classes_none_waits(self) -> None:
        assert ClassDropper[str]().crop("a", "a", 10) == ["a"]


def test_of_a_refused_payload_neither_the_bytes_nor_the_value_are_kept() -> None:
    secret = envelope(detections=[detection("person", confidence="hidden")])
    refused = ingest(payload(secret))
    assert not isinstance(refused, Accepted)
    assert "hidden" in refused.reason
    dropper = ClassDropper[None](["person"])
    kept = dropper.kept_of(payload(secret))
    assert isinstance(kept, Excerpt)
    assert (kept.start, kept.size) == (b"", len(payload(secret)))
    assert "hidden" not in dropper.reason(refused.reason)
    assert dropper.reason(refused.reason).startswith("detections.0.confidence: ")
    nothing = ClassDropper[None]()
    assert nothing.kept_of(b"x") == b"x"
    assert nothing.reason(refused.reason) == refused.reason


@pytest.mark.parametrize("kept", [b"whole", Excerpt(b"begin", 9000, "0" * 64)])
def test_the_refusal_of_another_log_is_kept_without_its_bytes(kept: bytes | Excerpt) -> None:
    event = RejectedPayload.encode("tb/detections", "confidence: wrong (got 'hidden')", kept)
    found = RejectedPayload.model_validate_json(ClassDropper[None](["a"]).refused_again(event))
    assert found.raw == b""
    assert found.size == (9000 if isinstance(kept, Excerpt) else 5)
    assert found.sha256 is not None
    assert "hidden" not in found.reason
    assert ClassDropper[None]().refused_again(event) == event
