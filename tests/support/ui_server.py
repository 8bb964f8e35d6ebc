"""``mapfold ui`` in a process of its own, and what it answers."""

import http.client
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from tests.support.commands import Commands
from tests.support.ready_program import ReadyProgram

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
