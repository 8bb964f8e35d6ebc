"""Costly and malformed messages and keys, sent beside an honest robot."""

import json
import threading
from collections.abc import Callable, Iterator
from random import Random

import zenoh

from eventsrc.record.transport.session import Session, ZenohOptions, open_session
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.forgery import mark_as_text
from scripts.programs.attack.oracle import Oracle
from scripts.programs.attack.robot import Robot
from tests.support.envelopes import detection, envelope

FLUSH_S = 60.0
PAUSE_S = 0.1
"""After each message, so that honest ones come between."""
MB = 1_000_000
SIXTEEN_MIB = 16 * 1024 * 1024
FAR_OVER_THE_LIMIT = 100 * 1024 * 1024

Junk = Callable[[Random, int], bytes]


def empty_detections(_: Random, size: int) -> bytes:
    """Each of them lacks every field."""
    head = b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":[{}'
    return head + b",{}" * ((size - len(head)) // 3) + b"]}"


def wrong_numbers(_: Random, size: int) -> bytes:
    """One detection whose box has very many corners, none of them a number."""
    box = b'"x",' * (size // 4)
    return (
        b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":[{"class":"c","confidence":1,'
        b'"bbox":[' + box + b"1]}]}"
    )


def many_fields(_: Random, size: int) -> bytes:
    """An object of very many unknown fields."""
    fields = b",".join(b'"%07d":NaN' % n for n in range(size // 14))
    return b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":[],' + fields + b"}"


def deep(_: Random, size: int) -> bytes:
    """Nested as deep as it is long."""
    return b"[" * size


def deep_unknown(_: Random, size: int) -> bytes:
    """A whole envelope with an unknown field that is nested deeply, in many copies."""
    nest = b"[" * 150 + b"]" * 150
    nests = b",".join([nest] * (size // 302))
    return b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":[],"x":[' + nests + b"]}"


def long_id(_: Random, size: int) -> bytes:
    """One string of control characters."""
    return b'{"run_id":"' + b"\\u0000" * (size // 6) + b'"}'


def long_number(_: Random, size: int) -> bytes:
    """One number of very many digits."""
    return b'{"run_id":"e","keyframe_id":' + b"9" * (size - 40) + b"}"


def long_embedding(_: Random, size: int) -> bytes:
    """One embedding that is no base64."""
    seen = [{**detection(), "embedding": "A" * (size - 300) + "!", "embedding_dim": 512}]
    return json.dumps(envelope(1, run_id="e", detections=seen)).encode()


def same_ids(_: Random, size: int) -> bytes:
    """Very many detections with one id."""
    one = json.dumps(detection("c", det_id="d")).encode()
    many = b",".join([one] * (size // (len(one) + 1)))
    head = b'{"run_id":"e","keyframe_id":1,"timestamp":1,"detections":['
    return head + many + b"]}"


def noise(rng: Random, size: int) -> bytes:
    """Random bytes."""
    return rng.randbytes(size)


KINDS: tuple[Junk, ...] = (
    *(empty_detections, wrong_numbers, many_fields, deep, deep_unknown),
    *(long_id, long_number, long_embedding, same_ids, noise),
)


def keys(rng: Random) -> Iterator[str]:
    """Keys that a recorder of everything must bear."""
    yield "tb/" + "k" * 22_000
    yield "tb/" + "/".join(["k"] * 10_000)
    yield "mapfold/loss"
    yield "mapfold/ack/" + "k" * 22_000
    yield f"tb/{mark_as_text(10**6)}"
    yield "tb/\x1b[2J\x07\u202e"
    yield "tb/" + "".join(chr(rng.randrange(0x100, 0xD800)) for _ in range(60))


def attack(arena: Arena) -> None:
    """Round 0: the cases; later ten messages and a key at random. The honest robot's envelopes
    are all acknowledged, and in the log, and the recorder ends when it is told to."""
    rng = arena.rng
    log, oracle, endpoint = arena.folder / "log", Oracle(), arena.router()
    recorder = arena.recorder(log, endpoint, "--key", "**")
    options = ZenohOptions(connect=(endpoint,))
    spool, pause = arena.folder / "spool", threading.Event()
    with (
        Robot(endpoint, spool, oracle, run_id="honest", per_second=100.0) as robot,
        open_session(options, mode="client") as session,
    ):
        robot.start()
        for payload, key in _messages(arena):
            _send(session, key, payload, oracle)
            pause.wait(PAUSE_S)
        session.confirm()
        if not robot.finish(FLUSH_S):
            arena.complain(f"{robot.publisher.unacknowledged} honest envelopes not acknowledged")
        if rng.random() < 0.5:
            recorder.kill()
            arena.run("reader", "log", "recover", log, codes=(0, 3))
        else:
            arena.finish(recorder)
        robot.note_acknowledged()
    arena.judge(oracle, log)
    arena.run("reader", "log", "info", log, codes=(0,))


def _messages(arena: Arena) -> Iterator[tuple[bytes, str]]:
    rng = arena.rng
    if arena.round == 0:
        for junk in KINDS:
            yield junk(rng, 2 * MB), "tb/detections"
        yield empty_detections(rng, SIXTEEN_MIB), "tb/detections"
        yield from [(bytes(FAR_OVER_THE_LIMIT), "tb/detections")] * 3
        for key in keys(rng):
            yield b"{}", key
        return
    for _ in range(10):
        size = rng.choice((100, 10_000, 10_000, MB, 2 * MB, SIXTEEN_MIB))
        yield rng.choice(KINDS)(rng, size), "tb/detections"
    yield noise(rng, 100), rng.choice([*keys(rng)])


def _send(session: Session, key: str, payload: bytes, oracle: Oracle) -> None:
    """Send without `Session`'s own checks, which would refuse such a key."""
    oracle.sent(payload)
    session.raw.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
