"""A server of S3 in this process, by moto, and a proxy before it that answers wrongly if told."""

import http.client
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.request import Request, urlopen

BUCKET = "logs"


@contextmanager
def s3_server() -> Iterator[str]:
    """The address of a server with the bucket `BUCKET`."""
    from moto.server import ThreadedMotoServer  # here: it takes seconds to import

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        address = f"http://{host}:{port}"
        with urlopen(Request(f"{address}/{BUCKET}", method="PUT")):
            yield address
    finally:
        server.stop()


def s3_environment(address: str) -> dict[str, str]:
    """What a program needs to use that server."""
    return {
        "AWS_ENDPOINT_URL": address,
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "AKIA-OF-A-TEST",
        "AWS_SECRET_ACCESS_KEY": "secret-of-a-test",
    }


@dataclass(frozen=True)
class Answer:
    """What a server answered; ``length`` is what its header claims."""

    status: int
    headers: dict[str, str]
    body: bytes
    length: int


Fault = Callable[[str, str, Answer], Answer]
"""Changes an answer, given the method and the path of its request."""


def _none(_method: str, _path: str, answer: Answer) -> Answer:
    return answer


@dataclass
class Proxy:
    """Answers as the server does, changed by ``fault``; notes each request."""

    fault: Fault = _none
    requests: list[tuple[str, str]] = field(default_factory=list)
    address: str = ""
    sent: int = 0


@contextmanager
def proxy_of(server: str) -> Iterator[Proxy]:
    """A proxy before a server."""
    proxy = Proxy()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _pass_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            upstream = http.client.HTTPConnection(server.removeprefix("http://"))
            try:
                upstream.request(self.command, self.path, body, dict(self.headers))
                reply = upstream.getresponse()
                data = reply.read()
                headers = dict(reply.getheaders())
            finally:
                upstream.close()
            length = int(headers.pop("Content-Length", len(data)))
            proxy.requests.append((self.command, self.path))
            answer = proxy.fault(
                self.command, self.path, Answer(reply.status, headers, data, length)
            )
            self._send(answer)

        def _send(self, answer: Answer) -> None:
            self.send_response(answer.status)
            for name, value in answer.headers.items():
                if name.lower() not in {"connection", "transfer-encoding", "date", "server"}:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(answer.length))
            self.end_headers()
            proxy.sent += len(answer.body)  # before the client has it and asks how much it was
            self.wfile.write(answer.body)
            if self.command != "HEAD" and len(answer.body) != answer.length:
                self.close_connection = True

        do_GET = do_PUT = do_HEAD = do_DELETE = do_POST = _pass_on  # noqa: N815 - as http.server calls it

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server_ = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server_.serve_forever, args=(0.01,))
    thread.start()
    proxy.address = f"http://127.0.0.1:{server_.server_port}"
    try:
        yield proxy
    finally:
        server_.shutdown()
        thread.join()
        server_.server_close()
