"""A balancer that passes HTTP requests on to several servers in turn."""

import itertools
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

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
