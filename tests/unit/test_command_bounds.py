"""The cost of a command from outside is bounded, whatever is in its 16 MiB."""

import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.commands import (
    KINDS,
    MAX_COMMAND_BYTES,
    MAX_JSON_VALUES,
    CorrectPoses,
    InvalidCommand,
    encode_command,
    parse_command,
)

MOST_S = 10.0
"""Of processor time; each takes less than one on an idle machine, most of what is refused here
would take minutes without the bounds."""
HEAD = b'"command_id":"a","issued_by":"b"'


def fields() -> bytes:
    return b",".join(b'"f%d":1' % i for i in range(500_000))


COSTLY: dict[str, Callable[[], bytes]] = {
    "lists in settings": lambda: (
        b'{"kind":"use-settings",%s,"settings":{"a":[%s]}}' % (HEAD, b",".join([b"[]"] * 5_000_000))
    ),
    "empty poses": lambda: (
        b'{"kind":"correct-poses",%s,"run_id":"r","poses":[%s]}'
        % (HEAD, b",".join([b"{}"] * 900_000))
    ),
    "too many empty poses": lambda: (
        b'{"kind":"correct-poses",%s,"run_id":"r","poses":[%s]}'
        % (HEAD, b",".join([b"{}"] * 4_000_000))
    ),
    "unknown fields": lambda: b'{"kind":"undo",%s,"undone":"c",%s}' % (HEAD, fields()),
    "unknown fields of a pose": lambda: (
        b'{"kind":"correct-poses",%s,"run_id":"r","poses":[{%s}]}' % (HEAD, fields())
    ),
    "det_ids": lambda: (
        b'{"kind":"drop-detection",%s,"det_ids":[%s]}' % (HEAD, b",".join([b'""'] * 900_000))
    ),
    "places": lambda: (
        b'{"kind":"undo-merge",%s,"merge_offset":1,"places":[%s]}'
        % (HEAD, b",".join([b"{}"] * 900_000))
    ),
    "depth": lambda: b"[" * 5_000_000,
    "one long text": lambda: b'{"kind":"undo",%s,"undone":"%s"}' % (HEAD, b"x" * 16_000_000),
    "too large": lambda: b" " * (MAX_COMMAND_BYTES + 1),
}
"""Made when they are needed: they take a second and a hundred megabytes."""
SAME_BOUND = {"places", "empty poses", "unknown fields of a pose"}
"""Refused as another of these is, in another field."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SAME_BOUND else []) for name in COSTLY],
)
@pytest.mark.seconds
def test_a_costly_command_is_refused_in_seconds(name: str) -> None:
    command = COSTLY[name]()
    before = time.process_time()
    with pytest.raises(InvalidCommand):
        parse_command(command)
    assert time.process_time() - before < MOST_S


@pytest.mark.seconds
def test_a_trajectory_of_an_hour_at_ten_hertz_fits() -> None:
    pose = b'{"keyframe_id":%d,"x":1.2345678901234567,"y":-7.6543210987654321,"yaw":0.123456789}'
    poses = b",".join(pose % k for k in range(36_000))
    sent = b'{"kind":"correct-poses",%s,"run_id":"r","poses":[%s]}' % (HEAD, poses)
    command = parse_command(sent)
    assert isinstance(command, CorrectPoses)
    assert len(command.poses) == 36_000
    assert parse_command(encode_command(command)) == command
    assert sent.count(b",") < MAX_JSON_VALUES


@given(
    st.one_of(
        st.binary(max_size=200),
        st.builds(
            b'{"kind":"%s",%s%s}'.__mod__,
            st.tuples(
                st.sampled_from([k.encode() for k in KINDS]), st.just(HEAD), st.binary(max_size=60)
            ),
        ),
        st.builds(
            b'{"kind":"use-settings",%s,"settings":{"a":"%s"}}'.__mod__,
            st.tuples(st.just(HEAD), st.sampled_from([b"\\ud800", b"\\u0000", b"\x80", b"\\"])),
        ),
    )
)
def test_any_bytes_are_a_command_or_one_error(sent: bytes) -> None:
    try:
        command = parse_command(sent)
    except InvalidCommand:
        return
    assert parse_command(encode_command(command)) == command
