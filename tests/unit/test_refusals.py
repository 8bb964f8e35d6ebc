"""What goes over the wire between recorders and robots, of this version and of others."""

import hashlib

import pytest
from pydantic import ValidationError

from eventsrc.acks import ACK_PREFIX, Ack, ack_key
from eventsrc.refusals import Refusal, Refusals, refusal_key


def test_an_ack_reads_as_it_always_did() -> None:
    ack = Ack(run_id="run-a", log_id="log", stretches=((0, 4), (7, 7)))
    assert ack.encode() == b'{"run_id":"run-a","log_id":"log","stretches":[[0,4],[7,7]]}'
    newer = b'{"run_id":"run-a","log_id":"log","stretches":[[0,4],[7,7]],"mood":"good"}'
    assert Ack.decode(newer) == ack


def test_a_refusal_names_the_bytes() -> None:
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
def test_no_run_is_called_like_the_refusals_of_a_key(name: str) -> None:
    assert refusal_key("tb/detections") == "mapfold/ack/refused/tb%2Fdetections"
    behind = refusal_key(name).removeprefix(ACK_PREFIX)
    assert behind.count("/") == 1, "so a recorder of an older version passes it over"
    assert "/" not in ack_key(name).removeprefix(ACK_PREFIX)
    assert not {"*", "?", "#", "$"} & set(refusal_key(name))


@pytest.mark.parametrize("name", ["k" * 1024, "🤖" * 256, "🤖" * 257, "é/" * 10_000, "k" * 60_000])
def test_the_key_of_an_answer_is_never_long(name: str) -> None:
    assert len(refusal_key(name)) < 4_000
    assert len(ack_key(name[:256])) < 4_000, "a run id has at most 256 characters"


def test_long_keys_have_refusals_of_their_own() -> None:
    one, other = refusal_key("a" * 2_000), refusal_key("a" * 1_999 + "b")
    assert one != other
    assert one == refusal_key("a" * 2_000)
    assert one.removeprefix(ACK_PREFIX).startswith("refused/=")
