"""Keyframes on their way out: a spool without room, crops without a subscriber."""

import threading
from collections.abc import Callable
from pathlib import Path

from eventsrc.adapters.detector.keyframes import CropJpeg, DetectedKeyframe
from eventsrc.adapters.detector.service import CropSender, ZenohOutput
from eventsrc.envelope.model import DetId
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, Session, ZenohOptions

NOBODY = ZenohOptions(connect=("tcp/127.0.0.1:9",))


def _keyframe(number: int) -> DetectedKeyframe:
    envelope = {"run_id": "r", "keyframe_id": number, "timestamp": 1.0, "detections": []}
    return DetectedKeyframe(envelope, [])


def test_a_full_spool_costs_a_camera_the_newest_keyframes(tmp_path: Path) -> None:
    said: list[str] = []
    stop = threading.Event()
    publisher = EnvelopePublisher(NOBODY, tmp_path / "spool", max_spool_bytes=200)
    output = ZenohOutput(publisher, None, stop, patient=False, note=said.append)
    for number in range(10):
        output.send(_keyframe(number))
    output.close(0.0)
    sent = output.delivered
    assert sent.published + sent.no_room == 10
    assert (
        sent.published
        == sent.waiting
        == 200 // len(b'{"run_id":"r","keyframe_id":0,"timestamp":1.0,"detections":[]}')
    )
    assert len(said) == 1
    assert "keyframe lost: " in said[0]


def test_what_waits_is_counted_while_it_waits(tmp_path: Path) -> None:
    publisher = EnvelopePublisher(NOBODY, tmp_path / "spool")
    output = ZenohOutput(publisher, None, threading.Event(), patient=False, note=lambda _line: None)
    for number in range(3):
        output.send(_keyframe(number))
        assert output.delivered.waiting == output.delivered.published == number + 1
    output.close(0.0)
    assert output.delivered.waiting == 3


def test_a_full_spool_makes_files_wait_until_they_are_stopped(tmp_path: Path) -> None:
    stop = threading.Event()
    publisher = EnvelopePublisher(NOBODY, tmp_path / "spool", max_spool_bytes=70)
    output = ZenohOutput(publisher, None, stop, patient=True, note=lambda _line: None)
    output.send(_keyframe(1))
    waiting = threading.Thread(target=output.send, args=(_keyframe(2),))
    waiting.start()
    waiting.join(0.4)
    assert waiting.is_alive()
    assert output.delivered.no_room == 0
    stop.set()
    waiting.join(10.0)
    assert not waiting.is_alive()
    output.close(0.0)
    assert (output.delivered.published, output.delivered.no_room) == (1, 1)


def test_crops_are_lost_or_taken(connected: Callable[[], Session]) -> None:
    said: list[str] = []
    sender = CropSender(connected(), "tb/crops", said.append)
    crop = CropJpeg(DetId("run/1 ?*#_kf1_d0"), b"jpeg")
    assert not sender.send(crop)
    assert not sender.send(crop)
    assert len(said) == 1
    assert "there is no subscriber to tb/crops/*" in said[0]
    came = threading.Event()
    got: list[Received] = []

    def take(message: Received) -> None:
        got.append(message)
        came.set()

    session = connected()
    session.subscribe("tb/crops/*", take)
    session.confirm()
    assert sender._heard.wait_for_subscriber(30.0)
    assert sender.send(crop)
    assert came.wait(30.0)
    assert got[0].key == "tb/crops/run%2F1%20%3F%2A%23_kf1_d0"
    assert got[0].payload == b"jpeg"
