"""The map for Foxglove: a recording, and a server that a client's timeline drives."""

import json
import logging
import os
import re
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.adapters.foxglove.playback import PROTOCOL, ClientTroubles, PastMaps, Playback
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import Settings
from projections.map.fold import Moments
from tests.support.commands import Commands, ReadyProgram
from tests.support.envelopes import detection, envelope
from tests.support.logs import sample_drive, write_log
from tests.support.maps import drawn_map, write_map_yaml

SAMPLE = sample_drive()
ROOMS = ("--set", "eps_m=0.75", "--set", "min_samples=8")
SETTINGS = Settings(eps_m=0.75, min_samples=8)
WAIT_S = 60.0


def fields(message: bytes) -> Iterator[tuple[int, Any]]:
    """Number and value of each field of a protobuf message; bytes where they have a length."""

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7

    at = 0
    while at < len(message):
        number, kind = divmod(varint(), 8)
        if kind == 0:
            yield number, varint()
        else:
            size = {1: 8, 5: 4}[kind] if kind != 2 else varint()
            yield number, message[at : at + size]
            at += size


def entities(scene: bytes) -> list[str]:
    """The ids of a foxglove.SceneUpdate's entities; it must delete all others."""
    parts = list(fields(scene))
    deletions = [dict(fields(value)) for number, value in parts if number == 1]
    assert [each[2] for each in deletions] == [1], "one deletion, of all"
    names = [dict(fields(value))[3] for number, value in parts if number == 2]
    return [name.decode() for name in names]


def expected_entities(state: dict[str, Any], merges: list[dict[str, Any]]) -> list[str]:
    """The ids that a scene of this map must have, by what the commands print."""
    names = [f"place/{place['place_id']}" for place in state["places"]]
    names += [f"object/{found['object_id']}" for found in state["objects"] if found["confirmed"]]
    names += ["adjacency"] if state["adjacency"] else []
    posed = [k["run_id"] for k in state["keyframes"] if k["map_x"] is not None]
    names += [f"path/{run}" for run in dict.fromkeys(posed) if posed.count(run) > 1]
    return names + [f"merge/{merge['offset']}" for merge in merges]


@dataclass
class Recording:
    """The messages of an MCAP file by topic: (log time, data)."""

    topics: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "Recording":
        found = cls()
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                found.topics.setdefault(channel.topic, []).append((message.log_time, message.data))
        return found

    def lines(self) -> list[str]:
        """What was logged as changes."""
        return [
            dict(fields(data))[3].decode() for _, data in self.topics.get("/mapfold/changes", [])
        ]


def test_a_recording_holds_events_verbatim_and_every_map(mapfold: Commands) -> None:
    said = mapfold("export", SAMPLE, "--foxglove", "m.mcap", "--every", "50", *ROOMS).err
    merges = mapfold("merges", SAMPLE, "--json", *ROOMS).json
    at = sorted({*range(50, 445, 50), 445, *(merge["offset"] + 1 for merge in merges)})
    assert said == f"wrote m.mcap: 445 events, {len(at)} scenes\n"
    recorded = Recording.read(mapfold.folder / "m.mcap")
    with LogReader(SAMPLE) as reader:
        events = list(reader.read())
    assert recorded.topics["tb/detections"] == [(e.stamp_ns, e.payload) for e in events]
    states = [json.loads(data) for _, data in recorded.topics["/mapfold/state"]]
    assert [state["offset"] for state in states] == at
    assert len(recorded.topics["/tf"]) == 445
    for end, (time_ns, scene) in zip(at, recorded.topics["/mapfold/map"], strict=True):
        if end in (at[0], at[len(at) // 2], 445):
            state = mapfold("state", SAMPLE, "--at", str(end), "--json", *ROOMS).json
            before = [merge for merge in merges if merge["offset"] < end]
            assert entities(scene) == expected_entities(state, before)
        assert time_ns == events[end - 1].stamp_ns
    lines = recorded.lines()
    for merge in merges:
        assert any(
            line.startswith(f"place {', '.join(merge['absorbed'])} merged into {merge['survivor']}")
            for line in lines
        ), merge
    founded = [line for line in lines if line.endswith("founded")]
    assert len(founded) == len(states[-1:]) * states[-1]["places"] + sum(
        len(merge["absorbed"]) for merge in merges
    )


def test_two_recordings_are_byte_identical(mapfold: Commands) -> None:
    for name in ("a.mcap", "b.mcap"):
        mapfold("export", SAMPLE, "--foxglove", name, "--at", "40")
    assert (mapfold.folder / "a.mcap").read_bytes() == (mapfold.folder / "b.mcap").read_bytes()
    assert not list(mapfold.folder.glob("*.partial"))


def test_a_recording_has_the_walls_of_each_floor(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(
        tmp_path / "log",
        [envelope(k, 0.3 * k, 0.0, detections=[detection("cup", [1.0])]) for k in range(4)],
    )
    walls = drawn_map("####\n#..#\n####", resolution=0.5, origin=(-1.0, -0.5, 0.0))
    path = write_map_yaml(tmp_path, "####\n#..#\n####", resolution=0.5, origin=[-1.0, -0.5, 0.0])
    mapfold("import", log, "--map", path)
    mapfold("export", log, "--foxglove", "m.mcap")
    recorded = Recording.read(tmp_path / "m.mcap")
    ((_, grid),) = recorded.topics["/mapfold/walls"]
    found = dict(fields(grid))
    assert (found[4], found[9]) == (struct.pack("<I", 4), walls.cells.tobytes())
    assert any("occupancy map of 4 × 3 cells given" in line for line in recorded.lines())


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--every", "3", "--dot", "m.dot"), "--every is for --foxglove"),
        (("--foxglove", "m.mcap", "--floor", "a"), "--foxglove shows all floors"),
        (("--foxglove", "file/m.mcap"), "file/m.mcap: cannot be written: File exists"),
        (("--foxglove", "folder"), "folder: cannot be written: Is a directory"),
    ],
)
def test_what_cannot_be_recorded_is_said(
    mapfold: Commands, options: tuple[str, ...], says: str
) -> None:
    (mapfold.folder / "file").touch()
    (mapfold.folder / "folder").mkdir()
    assert says in mapfold("export", SAMPLE, *options, code=2).err


def test_times_never_run_backwards(tmp_path: Path) -> None:
    stamps = [10.0, 12.0, 11.0, 15.0]
    log = write_log(tmp_path / "log", [envelope(k, timestamp=t) for k, t in enumerate(stamps)])
    with LogReader(log) as reader:
        moments = Moments(reader.read())
    assert [time // 10**9 for time in moments.times_ns] == [10, 12, 12, 15]
    assert moments.backwards == 1
    assert moments.span_ns == (10 * 10**9, 15 * 10**9)
    assert [moments.offset_at(t * 10**9) for t in (9, 10, 11, 12, 14, 15, 99)] == [
        0,
        1,
        1,
        3,
        3,
        4,
        4,
    ]


class Client:
    """Speaks the Foxglove WebSocket protocol as the app does; reads all topics."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.info = self._json("serverInfo")
        self.topics: dict[int, str] = {}
        self.messages: list[tuple[str, int, bytes]] = []
        self.states: list[tuple[int, int, float, bool, str]] = []
        self._advertised(self._json("advertise"))

    def _json(self, op: str) -> dict[str, Any]:
        message = json.loads(self.socket.recv(WAIT_S))
        assert message["op"] == op, message
        return message

    def _advertised(self, message: dict[str, Any]) -> None:
        new = [{"id": c["id"], "channelId": c["id"]} for c in message["channels"]]
        self.topics |= {c["id"]: c["topic"] for c in message["channels"]}
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": new}))

    def ask(self, *, play: bool, to: int | None = None, speed: float = 1.0) -> None:
        """A request of the timeline; ``to`` is a time to seek to, ns."""
        head = struct.pack("<BBfBQI", 3, not play, speed, to is not None, to or 0, 4)
        self.socket.send(head + b"asks")

    def until(self, done: Callable[[], bool]) -> None:
        """Read until ``done``."""
        while not done():
            received = self.socket.recv(WAIT_S)
            if isinstance(received, str):
                message = json.loads(received)
                assert message["op"] in ("advertise", "status"), message
                assert message["op"] == "advertise", message
                self._advertised(message)
            elif received[0] == 1:
                channel, time_ns = struct.unpack_from("<IQ", received, 1)
                self.messages.append((self.topics[channel], time_ns, received[13:]))
            elif received[0] == 5:
                status, time_ns, speed, sought, size = struct.unpack_from("<BQfBI", received, 1)
                told = received[19 : 19 + size].decode()
                self.states.append((status, time_ns, speed, bool(sought), told))
                if sought:
                    self.messages.clear()  # as the app does

    def last(self, topic: str) -> bytes | None:
        """The last message of a topic since the last seek."""
        return next((data for name, _, data in reversed(self.messages) if name == topic), None)

    def shown(self) -> dict[str, Any] | None:
        """The state that is shown, once its scene is."""
        found = self.last("/mapfold/state")
        return None if found is None else json.loads(found)


@contextmanager
def playing(log: Path, settings: Settings = SETTINGS) -> Iterator[tuple[Client, PastMaps]]:
    """A client of a server that runs."""
    with LogReader(log) as reader:
        maps = PastMaps(reader, settings, NO_CORRECTIONS, reader.next_offset)
        playback = Playback(maps, "log", "127.0.0.1", 0)
        thread = threading.Thread(target=playback.run)
        thread.start()
        try:
            with connect(
                f"ws://127.0.0.1:{playback.server.port}",
                subprotocols=[Subprotocol(PROTOCOL)],
                max_size=None,
            ) as socket:
                yield Client(socket), maps
        finally:
            playback.end()
            thread.join(WAIT_S)
        assert not thread.is_alive()


@pytest.mark.slow
def test_a_timeline_that_seeks_gets_the_map_of_each_moment(mapfold: Commands) -> None:
    merges = mapfold("merges", SAMPLE, "--json", *ROOMS).json
    with playing(SAMPLE) as (client, maps):
        assert "playbackControl" in client.info["capabilities"]
        client.until(lambda: client.shown() is not None)
        for end in (300, 1, 445, 241, 240):
            client.ask(play=False, to=maps.moments.time_of(Offset(end)))
            client.until(lambda end=end: (client.shown() or {}).get("offset") == end)  # type: ignore[misc]
            status, time_ns, _, sought, told = client.states[-1]
            assert (status, time_ns, sought, told) == (
                3 if end == 445 else 1,
                maps.moments.times_ns[end - 1],
                True,
                "asks",
            )
            state = mapfold("state", SAMPLE, "--at", str(end), "--json", *ROOMS).json
            shown = client.shown()
            assert shown is not None
            assert shown["digest"] == state["digest"]
            scene = client.last("/mapfold/map")
            assert scene is not None
            before = [merge for merge in merges if merge["offset"] < end]
            assert entities(scene) == expected_entities(state, before)


def test_playing_publishes_every_event_and_change_in_order_and_ends() -> None:
    with playing(SAMPLE) as (client, maps):
        client.ask(play=True, to=maps.moments.times_ns[0], speed=200.0)
        client.until(lambda: bool(client.states) and client.states[-1][0] == 3)
        client.until(lambda: (client.shown() or {}).get("offset") == 445)
        with LogReader(SAMPLE) as reader:
            events = [(e.stamp_ns, e.payload) for e in reader.read()]
        got = [(time, data) for topic, time, data in client.messages if topic == "tb/detections"]
        assert got == events[len(events) - len(got) :]
        assert len(got) > 400, "those of the moment sought, and those before the subscription"
        lines = [
            dict(fields(data))[3].decode()
            for topic, _, data in client.messages
            if topic == "/mapfold/changes"
        ]
        told = [line for _, line in maps.lines_between(Offset(0), Offset(445))]
        assert lines == told[len(told) - len(lines) :]
        assert len(lines) > 80


def test_pausing_stops_time() -> None:
    with playing(SAMPLE) as (client, maps):
        client.ask(play=True, to=maps.moments.times_ns[0], speed=10.0)
        client.until(lambda: (client.shown() or {}).get("offset", 0) > 5)
        client.ask(play=False)
        client.until(lambda: client.states[-1][0] == 1)
        paused_at = client.states[-1][1]
        client.ask(play=False)
        seen = len(client.states)
        client.until(lambda: len(client.states) > seen)
        assert client.states[-1][1] == paused_at


def test_odd_requests_are_answered() -> None:
    with playing(SAMPLE) as (client, maps):
        for to, speed in ((0, 1.0), (2**63, float("nan")), (5, -3.0)):
            client.ask(play=False, to=to, speed=speed)
            seen = len(client.states)
            client.until(lambda seen=seen: len(client.states) > seen)  # type: ignore[misc]
            assert client.states[-1][1] in maps.moments.span_ns
            assert client.states[-1][2] == 1.0


def test_an_empty_log_is_shown_empty(tmp_path: Path) -> None:
    with playing(write_log(tmp_path / "log", [])) as (client, _):
        client.until(lambda: client.shown() is not None)
        assert client.shown()["offset"] == 0  # type: ignore[index]
        assert entities(client.last("/mapfold/map") or b"") == []


def test_the_command_says_where_it_is_and_ends_by_a_signal(mapfold: Commands) -> None:
    read, write = os.pipe()
    program = mapfold.start("foxglove", SAMPLE, "--port", "0", stderr=write)
    os.close(write)
    server = ReadyProgram(program, read, ready_s=WAIT_S, end_s=WAIT_S)
    try:
        found = re.search(r"showing 445 events of \S+ at ws://127.0.0.1:(\d+)", server.text)
        assert found, server.text
        said = mapfold("foxglove", SAMPLE, "--port", found[1], code=2).err
        assert f"cannot listen on 127.0.0.1:{found[1]}" in said
        assert "give another --host or --port" in said
    finally:
        assert server.end() == 0
    assert server.said[-1] == "closed"


def test_clients_that_are_refused_or_not_understood_are_reported_once(mapfold: Commands) -> None:
    read, write = os.pipe()
    program = mapfold.start("foxglove", SAMPLE, "--port", "0", stderr=write)
    os.close(write)
    server = ReadyProgram(program, read, ready_s=WAIT_S, end_s=WAIT_S)
    try:
        assert f"it must speak {PROTOCOL}" in server.text
        (url,) = re.findall(r"ws://127.0.0.1:\d+", server.text)
        for _ in range(3):
            with pytest.raises(InvalidStatus) as refused:
                connect(url, subprotocols=[Subprotocol("foxglove.websocket.v1")])
            assert refused.value.response.status_code == 400
        with connect(url, subprotocols=[Subprotocol(PROTOCOL)]) as socket:
            client = Client(socket)
            socket.send("no JSON")
            with pytest.raises(AssertionError, match="Invalid message"):
                client.until(lambda: False)
    finally:
        assert server.end() == 0
    (refusal,) = (line for line in server.said if "handshake failed" in line)
    assert refusal.startswith("Dropping client 127.0.0.1: handshake failed; ")
    assert f"clients must speak {PROTOCOL}" in refusal
    assert len([line for line in server.said if line.startswith("Invalid message from")]) == 1
    assert server.said[-2:] == ["2 more troubles with clients", "closed"]


def test_troubles_of_clients_are_bounded() -> None:
    said: list[str] = []
    logger = logging.getLogger("foxglove.websocket")
    with ClientTroubles(said.append) as troubles:
        for number in range(200):
            logger.error("Invalid message from 127.0.0.1:%d: junk %d", number, number)
        logger.info("Registered client")
    logger.debug("not within")
    assert (len(said), troubles.unsaid) == (50, 150)
    assert said[7] == "Invalid message from 127.0.0.1: junk 7"


def test_the_layout_names_topics_that_there_are(mapfold: Commands) -> None:
    read, write = os.pipe()
    program = mapfold.start(
        "foxglove", SAMPLE, "--port", "0", "--layout", "new/l.json", stderr=write
    )
    os.close(write)
    server = ReadyProgram(program, read, ready_s=WAIT_S, end_s=WAIT_S)
    assert server.end() == 0
    assert "wrote new/l.json" in server.text
    text = (mapfold.folder / "new/l.json").read_text()
    assert json.loads(text)["version"] == 1
    with playing(SAMPLE) as (client, _):
        topics = {*client.topics.values(), "/mapfold/walls"}
        client.until(lambda: client.shown() is not None)
        counts = client.shown()
    named = set(re.findall(r"/mapfold/\w+", text))
    assert len(named) == 4
    assert named <= topics
    series = re.findall(r"/mapfold/state\.(\w+)", text)
    assert len(series) == 3
    assert set(series) <= set(counts or {})
