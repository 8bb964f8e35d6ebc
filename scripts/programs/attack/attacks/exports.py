"""Logs with hostile names and far poses, written in every format that `export`, `draw` and `state`
have, and read back with other people's readers; clients that trouble `mapfold foxglove`.

Each format must hold the Places and Objects that `state --json` prints, under names that differ.
"""

import csv
import json
import math
import random
import re
import signal
import socket
import struct
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from eventsrc.log import LogWriter
from eventsrc.record.append import append_payload
from projections.adapters.foxglove.playback import PROTOCOL
from scripts.programs.attack.arena import Arena
from tests.support.envelopes import detection, envelope, payload

SIGNS = (
    *"\"'`\\<>&;%,=+-@#{}[]()|/$^~*?!:. \u00a0\u202e\u2066\u2028\u2029\u200b\ufeff\ufffe\uffff",
    *("\U0010ffff", "\ue000", "e\u0301", "\u0130", "]]>", "<!--", "&#0;", "&amp;", "\\n", "\\x1b"),
    *(
        "=cmd|' /C calc'!A0",
        "{{7*7}}",
        "%s%n",
        "$(id)",
        "../..",
        "\\ufffe",
        "null",
        "~",
        "0",
        "- a",
    ),
)
LONGEST = 256
FAR_M = 10_000_000.0
WAIT_S = 30.0
CLIENTS = 30
LONGEST_LIFE_S = 2.0
FILES = ("m.graphml", "m.dot", "m.json", "t", "m.yaml")
EXPORT = ("--graphml", "m.graphml", "--dot", "m.dot", "--geojson", "m.json", "--csv", "t")
MORE = ("--csv-raw", "--nav2", "m.yaml")
ENDED = {signal.SIGINT: (0, 130, -signal.SIGINT), signal.SIGTERM: (0, 143, -signal.SIGTERM)}


def attack(arena: Arena) -> None:
    """One log a round: in round 0 far away, later also empty, of one keyframe or long names."""
    log = arena.folder / "log"
    _write(log, arena.rng, few=arena.round > 0)
    rules = ("--set", f"min_samples={arena.rng.choice((1, 2))}", "--set", "eps_m=1.0")
    state = _printed(arena, "state", log, "--json", *rules)
    for name, play in (
        ("formats", lambda: _formats(arena, log, rules, state)),
        ("interrupt", lambda: _interrupt(arena, log, rules)),
        ("foxglove", lambda: _foxglove(arena, log)),
    ):
        arena.attempt(name, play)


def _name(rng: random.Random) -> str:
    long = rng.random() < 0.1
    text = "".join(rng.choice(SIGNS) for _ in range(300 if long else rng.randrange(1, 8)))
    return text[:LONGEST].strip() or "a"


def _write(log: Path, rng: random.Random, *, few: bool) -> None:
    """A log of some runs, whose names differ by little."""
    keyframes = rng.choice((0, 1, 2, 30)) if few else 30
    names = [_name(rng) for _ in range(3)]
    classes, floors = [_name(rng) for _ in range(4)], [None, _name(rng), _name(rng)]
    scale = rng.choice((1.0, FAR_M)) if few else FAR_M
    with LogWriter(log) as writer:
        for k in range(keyframes):
            seen = [
                detection(
                    rng.choice(classes),
                    [rng.gauss(0, 1) for _ in range(4)],
                    det_id=f"{n}{_name(rng)}"[:LONGEST],
                )
                for n in range(rng.randrange(3))
            ]
            x = scale * rng.choice((-1, 0, 1)) + rng.uniform(-3, 3)
            at = max(-FAR_M, min(x, FAR_M)), rng.uniform(0, 3)
            document = envelope(k, *at, run_id=rng.choice(names), detections=seen)
            if (floor := rng.choice(floors)) is not None:
                document["floor"] = floor
            append_payload(writer, "tb/" + rng.choice(classes).replace("/", ""), payload(document))


def _printed(arena: Arena, *arguments: str | Path) -> Any:
    """The JSON document that a command prints."""
    return json.loads(arena.run("reader", *arguments, codes=(0,)).output())


def _formats(arena: Arena, log: Path, rules: tuple[str, ...], state: Mapping[str, Any]) -> None:
    recordings = ("--foxglove", "m.mcap", "--rerun", "m.rrd")
    arena.run("reader", "export", log, *rules, *EXPORT, *MORE, *recordings, codes=(0,))
    for suffix in ("svg", "png", "pdf"):
        arena.run("reader", "draw", log, *rules, "--out", f"m.{suffix}", codes=(0,))
    places = sorted(each["place_id"] for each in state["places"])
    objects = sorted(each["object_id"] for each in state["objects"])
    counts = (len(places), len(objects))
    for name, read in READERS.items():
        found = read(arena.folder)
        if found[0] != counts:
            arena.complain(f"{name} has {found[0]} Places and Objects of {counts}")
        if found[1] is not None and found[1] != places:
            arena.complain(f"{name} names Places {found[1]}, which are {places}")
    if (names := _nav2(arena.folder)) != places:
        arena.complain(f"the waypoints are {names}, the Places {places}")
    ET.parse(arena.folder / "m.svg")
    with (arena.folder / "m.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.message_encoding == "json":
                json.loads(message.data)


Found = tuple[tuple[int, int], list[str] | None]
"""Numbers of Places and Objects, and the Places' ids where the format has them unescaped."""


def _graphml(folder: Path) -> Found:
    import networkx

    nodes = networkx.read_graphml(folder / "m.graphml").nodes(data="kind")
    kinds = [kind for _, kind in nodes]
    return (kinds.count("Place"), kinds.count("Object")), None


_STATEMENT = re.compile(r'^\s*"((?:[^"\\]|\\.)*)" \[(.*)\];?$', re.MULTILINE)


def _dot(folder: Path) -> Found:
    text = (folder / "m.dot").read_text("utf-8")
    nodes = dict(_STATEMENT.findall(text))
    boxes = sum('shape="box"' in attributes for attributes in nodes.values())
    return (boxes, len(nodes) - boxes), None


def _geojson(folder: Path) -> Found:
    document = json.loads((folder / "m.json").read_bytes(), parse_constant=_refuse)
    kinds = [each["properties"] for each in document["features"]]
    places = sorted(each["place_id"] for each in kinds if each["kind"] == "place")
    return (len(places), sum(each["kind"] == "object" for each in kinds)), places


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _csv(folder: Path) -> Found:
    rows: dict[str, list[dict[str, str]]] = {}
    for name in ("places", "objects", "keyframes", "adjacency"):
        with (folder / "t" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            rows[name] = list(csv.DictReader(file, strict=True))
    places = sorted(each["place_id"] for each in rows["places"])
    return (len(places), len(rows["objects"])), places


def _nav2(folder: Path) -> list[str]:
    waypoints = yaml.safe_load((folder / "m.yaml").read_text("utf-8"))["waypoints"]
    return sorted(waypoints or {})


READERS: Mapping[str, Callable[[Path], Found]] = {
    "GraphML": _graphml,
    "DOT": _dot,
    "GeoJSON": _geojson,
    "CSV": _csv,
}
"""Of the files of `EXPORT`."""


def _interrupt(arena: Arena, log: Path, rules: tuple[str, ...]) -> None:
    """A signal while all formats are written over the old ones, which are whole afterwards."""
    files = [path for name in FILES for path in _files(arena.folder / name)]
    before = {path: path.read_bytes() for path in files}
    sent = arena.rng.choice([*ENDED])
    begun = arena.start("reader", "export", log, *rules, *EXPORT, *MORE)
    try:
        code = begun.process.wait(arena.rng.uniform(0.0, LONGEST_LIFE_S))
    except subprocess.TimeoutExpired:
        begun.process.send_signal(sent)
        code = begun.wait()
    if code not in ENDED[sent]:
        arena.complain(f"{begun.command} ended with {code} after {sent.name}")
    if {path: path.read_bytes() for path in files} != before:
        arena.complain(f"{begun.command} left other files after {sent.name}")
    if left := [*arena.folder.rglob("*.partial")]:
        arena.complain(f"{begun.command} left {left} after {sent.name}")


def _files(path: Path) -> Iterator[Path]:
    yield from path.iterdir() if path.is_dir() else (path,)


def _foxglove(arena: Arena, log: Path) -> None:
    """Clients that leave in the middle, do not read, or send junk; one that asks is answered."""
    rng = arena.rng
    server = arena.start("foxglove", "foxglove", log, "--port", "0")
    url = server.wait_for("showing ").rpartition(" ")[2]
    server.wait_for("in Foxglove: ")
    host, port = url.removeprefix("ws://").split(":")
    arena.run("reader", "foxglove", log, "--port", port, codes=(2,))
    with ExitStack() as held:
        for _ in range(CLIENTS):
            rng.choice((_leave, _stay_silent, _send_junk))(held, (host, int(port)), rng)
        if not _answered(url):
            arena.complain("a client among bad ones is not answered")
        arena.finish(server, codes=(0,))


def _leave(_: ExitStack, address: tuple[str, int], rng: random.Random) -> None:
    """In the middle of the handshake, or before it."""
    request = b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nSec-WebSocket-Protocol: x\r\n\r\n"
    with socket.create_connection(address, WAIT_S) as client:
        client.sendall(rng.choice((request, rng.randbytes(200)))[: rng.randrange(200)])


def _opened(address: tuple[str, int]) -> ClientConnection:
    host, port = address
    return connect(
        f"ws://{host}:{port}", subprotocols=[Subprotocol(PROTOCOL)], max_size=None, close_timeout=0
    )


def _stay_silent(held: ExitStack, address: tuple[str, int], rng: random.Random) -> None:
    """Subscribe to all there is, seek often, and read nothing."""
    client = held.enter_context(_opened(address))
    channels = json.loads(_received(client, "advertise"))["channels"]
    wanted = [{"id": each["id"], "channelId": each["id"]} for each in channels]
    client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    for _ in range(20):
        client.send(_request(rng))


def _send_junk(_: ExitStack, address: tuple[str, int], rng: random.Random) -> None:
    """What is no message, and requests that make no sense; then leave without a word."""
    client = _opened(address)
    for _ in range(10):
        junk = rng.choice(
            (
                rng.randbytes(rng.randrange(60)),
                _request(rng)[: rng.randrange(20)],
                '{"op":' * 500,
                json.dumps({"op": rng.choice(("subscribe", "unadvertise", "x")), "channelId": -1}),
                json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2**40}]}),
            )
        )
        client.send(junk)
    client.socket.shutdown(socket.SHUT_RDWR)


def _request(rng: random.Random) -> bytes:
    """A request of the timeline: play or not, at any speed, from any time."""
    speed = rng.choice((1.0, 0.0, -1.0, math.inf, math.nan, 1e30))
    time_ns = rng.choice((0, 1, 2**63, 2**64 - 1, rng.randrange(2**64)))
    return struct.pack("<BBfBQI", 3, rng.randrange(3), speed, 1, time_ns, 2) + b"id"


def _received(client: ClientConnection, op: str) -> str:
    while True:
        message = client.recv(WAIT_S)
        if isinstance(message, str) and json.loads(message)["op"] == op:
            return message


def _answered(url: str) -> bool:
    host, port = url.removeprefix("ws://").split(":")
    with _opened((host, int(port))) as client:
        _received(client, "advertise")
        client.send(struct.pack("<BBfBQI", 3, 1, 1.0, 1, 0, 2) + b"me")
        while True:
            message = client.recv(WAIT_S)
            if isinstance(message, bytes) and message[0] == 5 and message.endswith(b"me"):
                return True
