"""`mapfold serve` over HTTP with a token and without, and a client that reads its answers."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.guard import Guard, SafeHeaders
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from projections.surfaces.serve.metrics import CountedResponses, ServiceMetrics
from tests.support.http_attacks import ask, request, status

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
