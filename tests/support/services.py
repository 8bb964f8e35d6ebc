"""`mapfold serve` over HTTP with a token and without, and a client that reads its answers.

A small map in which every key of the service's answers is: names, floors, types, estimates.

A balancer that passes HTTP requests on to several servers in turn.
"""

import itertools
import json
import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.guard import Guard, SafeHeaders
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from projections.surfaces.serve.service_metrics import CountedResponses, ServiceMetrics
from tests.support.http_attacks import ask, request, status
from tests.support.logs import append_command, name_place, sample_drive, write_log

TOKEN = "0123456789abcdef-not-a-secret"
FRIEND = "https://map.example"
PATHS = ("/relocalize", "/state/places", "/state/objects", "/health", "/metrics")


class Service:
    """One port with a token and one without, of the same answerer."""

    def __init__(self, answerer: Answerer, port: int, secured: int) -> None:
        self.answerer, self.port, self.secured = answerer, port, secured

    def get(
        self, path: str, body: bytes | None = None, *, secured: bool = False, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of one answer."""
        method = headers.pop("method", "GET" if body is None else "POST")
        port = self.secured if secured else self.port
        got = ask(port, request(method, path, body or b"", headers))
        head, _, content = got.partition(b"\r\n\r\n")
        fields = (line.split(": ", 1) for line in head.decode().split("\r\n")[1:])
        return status(got), {name.lower(): value for name, value in fields}, content

    def document(self, path: str, body: Any = None, **headers: str) -> Any:
        """A good answer's JSON."""
        sent = None if body is None else json.dumps(body).encode()
        code, _, content = self.get(path, sent, **headers)
        assert code == 200, content
        return json.loads(content)


@contextmanager
def serving_twice(targets: Targets) -> Iterator[Service]:
    """Serve in a ``with`` block."""
    with Pools(targets, 2) as pools, FairQueue(2, max_wait_s=30.0) as queue:
        answerer = Answerer(pools, per_second=10_000.0)
        metrics = ServiceMetrics(answerer, queue)
        apps = [
            CountedResponses(
                SafeHeaders(
                    Guard(
                        create_app(answerer, queue, metrics, secured=token is not None),
                        token,
                        origins=(FRIEND,),
                    )
                ),
                metrics,
            )
            for token in (None, TOKEN)
        ]
        with (
            serving(apps[0], bind("127.0.0.1", 0)) as port,
            serving(apps[1], bind("127.0.0.1", 0)) as secured,
        ):
            yield Service(answerer, port, secured)


SETTINGS = Settings(fusion="evidence")
KEYFRAMES = 60
RUN = "sim-7-a"
MODEL = "mapfold-simulated-512"


def documents(count: int = KEYFRAMES) -> list[dict[str, Any]]:
    """The first keyframes of the sample log, on a floor with a name. What the first of them sees is
    measured too."""
    with LogReader(sample_drive()) as reader:
        found = [json.loads(event.payload) for event in reader.read(0, count)]
    for seen in found[0]["detections"]:
        x, y, yaw = (found[0][f"map_{name}"] for name in ("x", "y", "yaw"))
        at = (x + 2.0 * math.cos(yaw), y + 2.0 * math.sin(yaw))
        seen.update(position=at, position_z=0.4, size=(0.5, 0.5, 0.8))
    return [{**document, "floor": "ground"} for document in found]


def build(folder: Path, targets: Targets) -> Path:
    """The log of `documents`, with a named place, projected; the log's path."""
    log = write_log(folder / "log", documents())
    append_command(log, name_place(1, "bath", RUN))
    rebuild(log, targets, SETTINGS)
    return log


TIMEOUT_S = 30.0


@contextmanager
def round_robin(ports: Sequence[int]) -> Iterator[int]:
    """A balancer before the servers on these ports of loopback; its own port."""
    turns = itertools.cycle(ports)
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        """Passes one request on."""

        def _pass_on(self) -> None:
            with lock:
                port = next(turns)
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            server = HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
            try:
                server.request(self.command, self.path, body)
                answer = server.getresponse()
                content = answer.read()
            finally:
                server.close()
            self.send_response(answer.status)
            self.send_header("Content-Type", answer.headers["Content-Type"])
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = _pass_on  # noqa: N815 (names that http.server looks for)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as balancer:
        thread = threading.Thread(target=balancer.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield balancer.server_address[1]
        finally:
            balancer.shutdown()
            thread.join()
