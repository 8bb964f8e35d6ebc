"""Acks, refusals and progress on the wire, of this version and of others."""

import hashlib

import pytest
from pydantic import ValidationError

from eventsrc.record.robot.acks import (
    ACK_PREFIX,
    Ack,
    Refusal,
    Refusals,
    Sent,
    ack_key,
    refusal_key,
    sent_key,
)


def test_an_ack_names_payloads_by_sha256() -> None:
    ack = Ack(run_id="run-a", key="tb/x", log_id="log", sha256=("00", "ff"))
    written = b'{"run_id":"run-a","key":"tb/x","log_id":"log","sha256":["00","ff"]}'
    assert ack.encode() == written
    assert Ack.decode(written[:-1] + b',"mood":"good"}') == ack
    older = b'{"run_id":"run-a","log_id":"log","stretches":[[0,4]]}'
    for wrong in (older, written.replace(b'"00","ff"', b""), written.replace(b'"00"', b"0")):
        with pytest.raises(ValidationError):
            Ack.decode(wrong)


def test_progress_is_decoded_as_encoded() -> None:
    said = Sent(run_id="run-a", last=-(2**63))
    assert said.encode() == b'{"run_id":"run-a","last":-9223372036854775808}'
    assert Sent.decode(said.encode()) == said
    assert sent_key("tb/**") == "tb/**/@mapfold/sent"
    for wrong in (
        b"{}",
        b'{"run_id":"a","last":1.5}',
        b'{"run_id":"a","last":%d}' % 2**63,
    ):
        with pytest.raises(ValidationError):
            Sent.decode(wrong)


def test_a_refusal_names_a_payload_by_sha256_and_size() -> None:
    said = Refusals(log_id="log", refused=(Refusal.of(b"no json", "not JSON"),))
    sha256 = hashlib.sha256(b"no json").hexdigest()
    written = f'{{"log_id":"log","refused":[{{"sha256":"{sha256}","size":7,"reason":"not JSON"}}]}}'
    assert said.encode() == written.encode()
    assert Refusals.decode(said.encode()) == said
    with pytest.raises(ValidationError):
        Refusals.decode(b'{"log_id":"log","refused":[]}')


@pytest.mark.parametrize(
    "name", ["refused", "refused/tb", "tb/detections", "*", "a/**", "Küche 🤖"]
)
def test_no_ack_key_equals_a_refusal_key(name: str) -> None:
    assert refusal_key("tb/detections") == "mapfold/ack/refused/tb%2Fdetections"
    behind = refusal_key(name).removeprefix(ACK_PREFIX)
    assert behind.count("/") == 1, "so a recorder of an older version passes it over"
    assert "/" not in ack_key(name).removeprefix(ACK_PREFIX)
    assert not {"*", "?", "#", "$"} & set(refusal_key(name))


@pytest.mark.parametrize("name", ["k" * 1024, "🤖" * 256, "🤖" * 257, "é/" * 10_000, "k" * 60_000])
def test_a_refusal_key_is_bounded(name: str) -> None:
    assert len(refusal_key(name)) < 4_000
    assert len(ack_key(name[:256])) < 4_000, "a run id has at most 256 characters"


def test_long_keys_have_distinct_refusal_keys() -> None:
    one, other = refusal_key("a" * 2_000), refusal_key("a" * 1_999 + "b")
    assert one != other
    assert one == refusal_key("a" * 2_000)
    assert one.removeprefix(ACK_PREFIX).startswith("refused/=")
