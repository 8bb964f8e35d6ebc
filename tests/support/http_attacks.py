"""A raw HTTP client for what no honest client sends, and ``mapfold serve`` as a program."""

import os
import re
import socket
import ssl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.support import prefork
from tests.support.commands import ReadyProgram

DEADLINE_S = 30.0


def connect(port: int, source: str = "127.0.0.1", to: str = "127.0.0.1") -> socket.socket:
    """A TCP connection to a service of this machine, from one of its loopback addresses."""
    return socket.create_connection((to, port), DEADLINE_S, source_address=(source, 0))


def request(
    method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
) -> bytes:
    """The bytes of a request that ends its connection."""
    fields = {"Host": "127.0.0.1", "Content-Length": str(len(body)), "Connection": "close"}
    lines = [f"{name}: {value}" for name, value in {**fields, **(headers or {})}.items()]
    return "\r\n".join([f"{method} {path} HTTP/1.1", *lines, "", ""]).encode() + body


def answer(connection: socket.socket) -> bytes:
    """All that comes until the other end closes; a reset ends it too."""
    parts = []
    try:
        while part := connection.recv(65_536):
            parts.append(part)
    except (ConnectionResetError, ssl.SSLError):
        pass
    return b"".join(parts)


def ask(port: int, sent: bytes, *, source: str = "127.0.0.1", to: str = "127.0.0.1") -> bytes:
    """What comes back for these bytes on a connection of their own."""
    with connect(port, source, to) as connection:
        connection.sendall(sent)
        return answer(connection)


def status(response: bytes) -> int:
    """The status of a response."""
    return int(response.split(maxsplit=2)[1])


_LIMITED = """
import resource, sys
if limit := sys.argv.pop(1):
    resource.setrlimit(resource.RLIMIT_NOFILE, (int(limit), int(limit)))
sys.argv[1:1] = [] if sys.argv[1:2] == ["mcp"] else ["serve"]
from projections.surfaces.cli import main
main()
"""


class Served(ReadyProgram):
    """``mapfold serve --http``, or ``mapfold mcp --http``, in a process of its own."""

    def __init__(self, *args: str, open_files: int | None = None, **env: str) -> None:
        clean = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
        said, stderr = os.pipe()
        program = prefork.start(
            _LIMITED,
            ["-c", str(open_files or ""), *args],
            env={**clean, **env},
            cwd=Path.cwd(),
            stderr=stderr,
        )
        os.close(stderr)
        super().__init__(program, said, ready_s=120.0, end_s=DEADLINE_S)
        found = re.search(r"answering https?://\S+:(\d+)", self.text)
        assert found, self.text
        self.port = int(found[1])

    @property
    def peak_bytes(self) -> int:
        """The most memory that it has had resident."""
        text = Path(f"/proc/{self.program.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", text)
        assert found
        return int(found[1]) * 1024


@contextmanager
def served(*args: str, open_files: int | None = None, **env: str) -> Iterator[Served]:
    """Serve until the end of the block; it must end well and must not have shown a traceback."""
    service = Served(*args, open_files=open_files, **env)
    try:
        yield service
    except BaseException:
        service.end()
        raise
    assert service.end() == 0, service.text
    assert "Traceback" not in service.text, service.text
