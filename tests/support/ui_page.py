"""``mapfold ui`` in a process of its own, and what it answers.

A slow, obvious client of the web debugger: it reads the arrays and replays them row by row.
"""

import http.client
import json
import math
import os
import re
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from tests.support.commands import Commands, ReadyProgram

WAIT_S = 60.0


@dataclass(frozen=True)
class Answered:
    """A status, headers in lower case, and the body."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        """The body as JSON, of UTF-8."""
        return json.loads(self.body.decode("utf-8"))

    @property
    def error(self) -> tuple[int, str, str]:
        """Status, kind and message of a refusal."""
        error = self.json["error"]
        return self.status, error["kind"], error["message"]


class UiServer(ReadyProgram):
    """A running server."""

    def __init__(self, mapfold: Commands, *args: str | Path) -> None:
        read, write = os.pipe()
        program = mapfold.start("ui", *args, stderr=write)
        os.close(write)
        super().__init__(program, read, ready_s=WAIT_S, end_s=WAIT_S)
        found = re.search(r"showing .* at http://(\S+?):(\d+)/(?:\?token=([^\s#]+))?", self.text)
        assert found, self.text
        self.host, self.port, self.token = found[1], int(found[2]), found[3]

    def ask(
        self,
        path: str,
        *,
        method: str = "GET",
        body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        **query: Any,
    ) -> Answered:
        """One request on a connection of its own."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=WAIT_S)
        target = f"{path}?{urlencode(query, doseq=True)}" if query else path
        try:
            connection.request(method, target, body, dict(headers or {}))
            got = connection.getresponse()
            found = {name.lower(): value for name, value in got.getheaders()}
            return Answered(got.status, found, got.read())
        finally:
            connection.close()

    def api(self, path: str, **query: Any) -> Any:
        """The JSON of a question that must be answered."""
        got = self.ask(f"/api/{path}", **query)
        assert got.status == 200, got.body
        return got.json

    def edit(self, kind: str, *arguments: str, **more: Any) -> Answered:
        """An edit with the token."""
        body = json.dumps({"kind": kind, "arguments": arguments, **more}).encode()
        bearer = {"Authorization": f"Bearer {self.token}"}
        return self.ask("/api/edit", method="POST", body=body, headers=bearer)

    @contextmanager
    def live(self) -> Iterator[Iterator[dict[str, Any]]]:
        """The events of ``/api/live``, as they come. While the server refuses, the request is
        repeated: a stream that was closed is counted until the server notices it."""
        deadline = time.monotonic() + WAIT_S
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=WAIT_S)
        try:
            while True:
                connection.request("GET", "/api/live")
                got = connection.getresponse()
                if got.status != 503 or time.monotonic() > deadline:
                    break
                got.read()
            assert got.status == 200, got.read()
            assert got.getheader("content-type", "").startswith("text/event-stream")
            yield (
                json.loads(line.removeprefix(b"data: "))
                for line in iter(got.readline, b"")
                if line.startswith(b"data: ")
            )
        finally:
            connection.close()


@contextmanager
def showing(mapfold: Commands, *args: str | Path) -> Iterator[UiServer]:
    """A server that must end well and without a traceback."""
    server = UiServer(mapfold, *args)
    try:
        yield server
    finally:
        code = server.end()
    assert "Traceback" not in server.text, server.text
    assert code == 0, server.text
    assert server.said[-1] == "page closed"


def until(heard: Iterator[dict[str, Any]], holds: Callable[[dict[str, Any]], bool]) -> Any:
    """The first document for which it holds; the stream's own timeout is the deadline."""
    return next(each for each in heard if holds(each))


def digest(mapfold: Commands, log: Path) -> str:
    """The digest that the command prints."""
    return mapfold("state", log, "--digest").out.strip()


_CODES = {"i8": "q", "f8": "d", "f4": "f", "i4": "i", "u4": "I", "u1": "B"}


def read_arrays(answer: bytes) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The header and the arrays of ``/api/history``, by the description in docs/ui.md."""
    (length,) = struct.unpack_from("<I", answer)
    header = json.loads(answer[4 : 4 + length])
    arrays, end = {}, 4 + length
    for each in header["arrays"]:
        assert each["offset"] % 8 == 0
        assert set(answer[end : each["offset"]]) <= {0}  # nothing but padding in between
        code = f"<{each['length']}{_CODES[each['dtype']]}"
        arrays[each["name"]] = list(struct.unpack_from(code, answer, each["offset"]))
        end = each["offset"] + struct.calcsize(code)
    return header, arrays


def as_float32(value: float) -> float:
    """The nearest float32."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


@dataclass
class ReplayedMap:
    """The map at W as a page sees it."""

    keyframes: list[tuple[str, int, int | None]] = field(default_factory=list)
    """Run, id, and the place's number."""
    poses: list[tuple[float, float, float] | None] = field(default_factory=list)
    places: dict[int, list[int]] = field(default_factory=dict)
    """Members by place."""
    place_ids: dict[int, str] = field(default_factory=dict)
    names: dict[int, str] = field(default_factory=dict)
    objects: dict[int, dict[str, Any]] = field(default_factory=dict)
    adjacency: dict[tuple[int, int], int] = field(default_factory=dict)


def replay(header: dict[str, Any], arrays: dict[str, list[Any]], end: int) -> ReplayedMap:
    """Apply every row below ``end``, in the order of offsets."""
    found = ReplayedMap()
    place_of: dict[int, int] = {}
    survivor: dict[int, int] = {}
    object_gone: set[int] = set()
    rows: list[tuple[int, int, str, int]] = []
    for order, prefix in enumerate(("kf", "pf", "pl", "mg", "of", "oc", "om", "ad")):
        offsets = arrays[f"{prefix}_offset"]
        assert offsets == sorted(offsets), prefix
        rows += [(offset, order, prefix, index) for index, offset in enumerate(offsets)]
    strings = header["strings"]
    for offset, _, prefix, i in sorted(rows):
        if offset >= end:
            break
        row = {
            name.removeprefix(f"{prefix}_"): values[i]
            for name, values in arrays.items()
            if name.startswith(f"{prefix}_")
        }
        if prefix == "kf":
            found.keyframes.append((strings["run_id"][row["run"]], row["number"], None))
            x, y, yaw = row["x"], row["y"], row["yaw"]
            found.poses.append(None if math.isnan(x) else (x, y, yaw))
        elif prefix == "pf":
            found.place_ids[row["place"]] = strings["place_id"][row["place"]]
        elif prefix == "pl":
            place_of[row["keyframe"]] = row["place"]
        elif prefix == "mg":
            survivor[row["absorbed"]] = row["survivor"]
        elif prefix == "of":
            found.objects[row["object"]] = {"id": strings["object_id"][row["object"]]}
        elif prefix == "oc":
            found.objects[row["object"]].update(
                x=row["x"], y=row["y"], xx=row["xx"], xy=row["xy"], yy=row["yy"],
                count=row["count"], class_name=strings["class"][row["class"]],
                place=None if row["place"] < 0 else row["place"], missing=bool(row["missing"]),
                confirmed=bool(row["confirmed"]),
            )  # fmt: skip
        elif prefix == "om":
            object_gone.add(row["absorbed"])
        elif row["count"]:
            found.adjacency[row["a"], row["b"]] = row["count"]
        else:
            found.adjacency.pop((row["a"], row["b"]), None)
    for keyframe, place in place_of.items():
        while place in survivor:
            place = survivor[place]
        run, number, _ = found.keyframes[keyframe]
        found.keyframes[keyframe] = run, number, place
        found.places.setdefault(place, []).append(keyframe)
    for named in header["names"]:
        if named["offset"] < end:
            found.names[named["place"]] = named["name"]
    found.names = {
        p: name for p, name in found.names.items() if name is not None and p not in survivor
    }
    found.objects = {o: v for o, v in found.objects.items() if o not in object_gone}
    found.place_ids = {p: v for p, v in found.place_ids.items() if p not in survivor}
    for members in found.places.values():
        members.sort()
    return found
