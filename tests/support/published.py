"""Acknowledgements as a recorder sends them, and what of a robot is in a log."""

import json
from pathlib import Path

from eventsrc.log import LogReader
from eventsrc.record.robot.acks import Ack, payload_sha256
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import ZenohOptions
from tests.support.fixtures_log import KEY


def robot_at(endpoint: str, folder: Path) -> EnvelopePublisher:
    """A publisher that sends again soon."""
    return EnvelopePublisher(
        ZenohOptions(connect=(endpoint,)), folder / "spool", resend_after_s=0.2
    )


def encoded_ack(*payloads: bytes, key: str = KEY) -> bytes:
    """A recorder's acknowledgement of these."""
    digests = tuple(map(payload_sha256, payloads))
    return Ack(run_id="run-a", key=key, log_id="log", sha256=digests).encode()


def stored_payloads(log: Path) -> list[bytes]:
    """Envelopes in a log."""
    with LogReader(log) as reader:
        return [event.payload for event in reader.read(keys={KEY})]


def keyframe_ids(log: Path) -> set[int]:
    """Ids of the keyframes in a log."""
    return {json.loads(p)["keyframe_id"] for p in stored_payloads(log)}
