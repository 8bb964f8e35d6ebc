"""`--drop-class`: what is never stored is nowhere in the log, from whichever input it came."""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from eventsrc.envelope.crops import CROPS_TOPIC, Crop, decode_crop, encode_crop
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.model import ENVELOPE_VERSION, DetId, default_det_id
from eventsrc.envelope.system_events import (
    DROP_KEY,
    EMBEDDINGS_KEY,
    REJECTED_KEY,
    NewVectors,
    RejectedPayload,
)
from eventsrc.log import LogReader, LogWriter, NewEvent, verify_log
from eventsrc.record.append import CROP_FORMAT, dropped_classes
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.recorder.checking import CheckedMessage
from eventsrc.record.recorder.queue import CropMessage, MessageQueue
from eventsrc.record.recorder.writer_thread import WriterThread
from eventsrc.record.robot.acks import Ack, payload_sha256
from eventsrc.record.transport.session import Received, Session
from eventsrc.ros.derivation import CDR
from projections.surfaces.cli.bridge_options import recording_of
from tests.support import ros2dds
from tests.support.byte_search import holds
from tests.support.commands import Commands
from tests.support.envelopes import detection, embedding, envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.fixtures_zenoh import Program
from tests.support.ros2dds import KINDS
from tests.support.ros2dds_recordings import announce_all, choice, envelopes, recording, send_all
from tests.support.ros_messages import TYPES

PERSON, CUP = [0.123, 0.456, 0.789, 1.5], [4.25, 3.75, 2.5, 1.25]
JPEG_OF_PERSON = b"\xff\xd8\xff" + b"the face of a person" + b"\xff\xd9"
JPEG_OF_CUP = b"\xff\xd8\xff" + b"a cup with a handle" + b"\xff\xd9"


def vector(values: list[float]) -> bytes:
    return str(embedding(values)["embedding"]).encode()


NEVER_STORED = (vector(PERSON), base64.b64decode(vector(PERSON)), JPEG_OF_PERSON, b"4f2c.5")
STORED = (vector(CUP), JPEG_OF_CUP)


def seen(number: int) -> dict[str, Any]:
    """A keyframe that shows a person and a cup."""
    person = detection("person", PERSON, note="4f2c.5")
    return envelope(number, detections=[person, detection("cup", CUP)])


def ids(number: int) -> tuple[DetId, DetId]:
    document = seen(number)
    first, second = (default_det_id(document["run_id"], number, i) for i in (0, 1))
    return first, second


def crops_in(log: Path) -> list[str]:
    return [decode_crop(e.payload).det_id for e in read_log(log) if e.key == CROPS_TOPIC]


def found_in(log: Path) -> list[tuple[str, bytes]]:
    """What should not be in the log but is; checks that the search finds what should."""
    assert {needle for _, needle in holds(log, STORED)} == {*STORED}
    return holds(log, NEVER_STORED)


def test_a_recorder_stores_nothing_of_them(log_path: Path) -> None:
    """Neither of envelopes, nor of crops that come before or after these, nor of what is refused;
    robots get acknowledgements of what they sent."""
    sent = payload(seen(1)), payload(seen(2))
    person, cup = ids(1)
    bare = [{"class_name": "person", "confidence": 1.0, "bbox": [0, 0, 1, 1], "note": "4f2c.5"}]
    broken = payload({**seen(3), "timestamp": "late"})
    valued = payload(envelope(4, detections=[detection("person", confidence="4f2c.5")]))
    messages = [
        CropMessage(f"tb/crops/{quote(person)}", JPEG_OF_PERSON),
        CropMessage(f"tb/crops/{quote(cup)}", JPEG_OF_CUP),
        *(Received(KEY, each) for each in sent),
        CropMessage(f"tb/crops/{quote(ids(2)[0])}", JPEG_OF_PERSON),
        CropMessage(f"tb/crops/{quote(ids(2)[1])}", JPEG_OF_CUP),
        CropMessage("tb/crops/nothing-known", JPEG_OF_PERSON),
        CropMessage("tb/crops/no-jpeg", JPEG_OF_PERSON[1:]),
        *(Received(KEY, each) for each in (payload(bare), broken, valued)),
    ]
    queue, replies = MessageQueue(), list[tuple[str, bytes]]()
    for message in messages:
        queue.put(message)
    queue.close()
    with LogWriter(log_path) as writer:
        thread = WriterThread(
            *(queue, writer, None, lambda *reply: replies.append(reply)),
            max_events=None,
            report_gaps=False,
            max_payload_bytes=2**20,
            dropper=ClassDropper(["person"]),
        )
        thread.run()
        report = thread.report()
    assert report.dropped == (3, 3)
    assert (report.recorded, report.crops, report.rejected) == (3, 2, 3)
    assert crops_in(log_path) == [cup, ids(2)[1]]
    acks = [Ack.decode(reply) for key, reply in replies if "/refused/" not in key]
    assert [sha256 for ack in acks for sha256 in ack.sha256] == [*map(payload_sha256, sent)]
    assert found_in(log_path) == []
    counts = [
        json.loads(e.payload).get("dropped_detections")
        for e in read_log(log_path)
        if e.is_envelope and e.version == ENVELOPE_VERSION
    ]
    assert counts == [1, 1]
    refused = [
        RejectedPayload.model_validate_json(e.payload)
        for e in read_log(log_path)
        if e.key == REJECTED_KEY
    ]
    assert [each.raw for each in refused] == [b""] * 3
    assert verify_log(log_path).findings == ()


def test_it_is_said_once_and_later_recordings_obey(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    for number in (1, 2):
        (tmp_path / f"{number}.jsonl").write_bytes(payload(seen(number)))
    (tmp_path / "unnamed.jsonl").write_bytes(payload(envelope(4, detections=[detection("0", CUP)])))
    (tmp_path / "named.jsonl").write_bytes(
        payload(envelope(5, detections=[detection("0", PERSON, note="4f2c.5")]))
    )
    said = run("import", "log", "1.jsonl", "--drop-class", "person", "--json")
    assert "detections of person are not stored in this log" in said.err
    assert "1 detection dropped by class" in said.err
    assert said.json["dropped"] == {"detections": 1, "crops": 0}
    run("import", "log", "unnamed.jsonl")
    run("edit", "log", "relabel", "0=person", "--reason", "test")
    assert run("import", "log", "2.jsonl", "--json").json["dropped"]["detections"] == 1
    assert run("import", "log", "named.jsonl", "--json").json["dropped"]["detections"] == 1
    again = run("import", "log", "1.jsonl", "--drop-class", "person", "--json").json
    assert [(each["what"], each["count"]) for each in again["passed_over"]] == [
        ("in the log already", 1)
    ]
    more = run("import", "log", "2.jsonl", "--drop-class", "cup", "--drop-class", "person")
    assert "detections of cup, person are" in more.err
    said_at = [e for e in read_log(tmp_path / "log") if e.key == DROP_KEY]
    assert [json.loads(e.payload)["classes"] for e in said_at] == [["person"], ["cup", "person"]]
    assert holds(tmp_path / "log", NEVER_STORED) == []
    assert "--drop-class" in run("import", "log", "2.jsonl", "--drop-class", "", code=2).err
    run("log", "verify", "log", code=3)  # the second recording of keyframe 2, without the cup


def other_log(path: Path) -> None:
    """A log with all that an import takes over, the crops before their envelopes."""
    person, cup = ids(1)

    def crop(det_id: DetId, jpeg: bytes) -> NewEvent:
        kept = encode_crop(Crop(det_id, jpeg), 1)
        return NewEvent(CROPS_TOPIC, kept, 10, 10, format=CROP_FORMAT)

    vectors = NewVectors("B", "0" * 64, (person, cup), _vectors())
    refused = RejectedPayload.encode(KEY, "wrong", payload(seen(9)))
    picture = CROP_FORMAT._replace(schema="sensor_msgs/msg/Image")
    with LogWriter(path) as writer:
        writer.append_all(
            [
                *(crop(person, JPEG_OF_PERSON), crop(cup, JPEG_OF_CUP)),
                NewEvent(KEY, payload(seen(1)), 11, 11),
                crop(person, JPEG_OF_PERSON + b"again\xff\xd9"),
                NewEvent(EMBEDDINGS_KEY, vectors.encode(), 12, 12),
                NewEvent(REJECTED_KEY, refused, 13, 13),
                NewEvent("/camera", JPEG_OF_PERSON, 14, 14, format=picture),
                NewEvent("/tf", b"\0\1\0\0where", 15, 15, format=_transforms()),
            ]
        )


def _vectors() -> Any:
    import numpy as np  # every worker imports every test module

    return np.array([PERSON, CUP], np.float32)


def _transforms() -> Any:
    return CROP_FORMAT._replace(encoding=CDR, schema="tf2_msgs/msg/TFMessage")


def test_an_import_of_another_log_takes_nothing_of_them(tmp_path: Path) -> None:
    other_log(tmp_path / "other")
    assert holds(tmp_path / "other", NEVER_STORED)
    run = Commands.in_folder(tmp_path)
    said = run("import", "log", "other", "--drop-class", "person", "--json")
    assert said.json["dropped"] == {"detections": 1, "crops": 2}
    assert crops_in(tmp_path / "log") == [ids(1)[1]]
    assert found_in(tmp_path / "log") == []
    assert [e.key for e in read_log(tmp_path / "log")][-1] == "/tf"
    again = run("import", "log", "other", "--json").json  # and a second time nothing new
    assert again["next_offset"] - again["first_offset"] == again["rejected"] == 0
    run("import", "third", "log")
    with LogReader(tmp_path / "third") as reader:
        assert dropped_classes(reader) == {"person"}


def test_messages_of_ros_are_kept_without_those_that_show_them(
    log_path: Path, endpoint: str, connected: Callable[[], Session]
) -> None:
    """Verbatim messages of detections and embeddings are not kept; envelopes are made of them."""
    ros_recording, topics = recording_of(choice(), 0, None)
    dropper = ClassDropper[CheckedMessage](["thing-1"])
    own = Bridge(ros_recording, topics, TYPES, dropper=dropper)
    sent = ros2dds.drive(6)
    with (
        ros2dds.bridge(endpoint) as bridge,
        recording(connected(), log_path, own, dropper=dropper) as running,
    ):
        announce_all(bridge)
        running.wait_until(lambda _: len(own.types_known) >= len(KINDS))
        send_all(bridge, sent)
        running.wait_until(lambda report: report.dropped.detections >= 2)
    report = running.finish()
    assert report.dropped == (2, 0)
    events = read_log(log_path)
    made = [json.loads(e.payload) for e in envelopes(events)]
    assert len(made) == 6
    classes = [[each["class"] for each in one["detections"]] for one in made]
    assert classes == [["thing-0"], [], ["thing-2"]] * 2
    assert not {"/detections", "/embeddings"} & {e.key for e in events}
    assert {"/tf", "/tf_static"} <= {e.key for e in events}
    (shown,) = {d["embedding"] for d in made[0]["detections"]}
    hidden = vector([1.0, 1.0, 0.5, 0.25])
    assert {needle for _, needle in holds(log_path, [shown.encode()])} == {shown.encode()}
    assert holds(log_path, [hidden, base64.b64decode(hidden), b"thing-1"]) == []


def test_other_topics_are_refused_where_classes_are_dropped(
    tmp_path: Path, endpoint: str, start: Callable[..., Program]
) -> None:
    log = str(tmp_path / "log")
    words = ("--connect", endpoint, "--ros2dds", "--drop-class", "person", "--topic", "/camera")
    refused = start("record", log, *words)
    assert refused.wait() == 2
    assert any("--topic /camera keeps messages as they are" in each for each in refused.lines)
