"""The HTTP server: a bound address, TLS, and uvicorn with limits on accepted connections.

asyncio accepts without a limit, and TLS handshakes in progress are not counted. Here each
connection is counted from the moment it is accepted (`connections`), and a few are accepted in each
turn of the event loop, so that open connections are served in between.
"""

import asyncio
import contextlib
import ipaddress
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import uvicorn
from starlette.types import ASGIApp

from eventsrc.base.errors import MisuseError, TransportError
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, open_file

from .answering import RepeatFilter
from .connections import MAX_CONNECTIONS, REQUEST_S, Connection, Connections

_BACKLOG: Final = 1024
_KEEP_ALIVE_S: Final = 5
_PAUSE_S: Final = 0.1
_AT_ONCE: Final = 32
"""Connections accepted in a turn of the event loop. A turn takes milliseconds when many are being
answered: with one a turn a newcomer waited four seconds behind a thousand others."""


def bind(host: str, port: int, option: str = "--http") -> socket.socket:
    """A socket bound to the address of ``option``, not listening yet. Raises TransportError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol's number, which accepted sockets inherit: without it asyncio leaves Nagle's
    # algorithm on, and each answer on a used connection comes 40 ms late.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except (OSError, TypeError, UnicodeError) as error:  # the latter for what is no name of a host
        listener.close()
        reason = getattr(error, "strerror", None) or error
        raise TransportError(
            f"cannot listen on {visible(host)}:{port}: {reason}; give another {option}"
        ) from None
    return listener


def is_loopback(listener: socket.socket) -> bool:
    """Whether only this machine can connect."""
    return ipaddress.ip_address(listener.getsockname()[0].partition("%")[0]).is_loopback


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """A server's TLS context with this certificate. Raises MisuseError naming the unusable file."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    for option, file in (("--tls-cert", certificate), ("--tls-key", key)):
        try:
            open_file(file).close()
        except FileFault as fault:
            raise MisuseError(f"{option} {file}: {fault}") from None
    try:
        context.load_cert_chain(certificate, key, password=lambda: b"")  # never prompt
    except (ssl.SSLError, ValueError) as error:
        why = getattr(error, "reason", None) or error
        raise MisuseError(
            f"--tls-cert {certificate} with --tls-key {key}: {why}; give a certificate and its key"
            " in PEM, the key without a password"
        ) from None
    return context


class _Server(uvicorn.Server):
    def __init__(
        self, config: uvicorn.Config, connections: Connections, tls: ssl.SSLContext | None
    ) -> None:
        super().__init__(config)
        self._connections = connections
        self._opening: set[asyncio.Task[None]] = set()
        self._resumptions: dict[socket.socket, asyncio.TimerHandle] = {}
        # Without TLS asyncio does not take these options.
        self._tls: dict[str, Any] = (
            {}
            if tls is None
            else {"ssl": tls, "ssl_handshake_timeout": REQUEST_S, "ssl_shutdown_timeout": 1.0}
        )

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self.servers = []
        await self.lifespan.startup()
        self._loop = asyncio.get_running_loop()
        for listener in sockets or ():
            self._loop.add_reader(listener, self._accept, listener)
        self.started = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for listener in sockets or ():
            self._loop.remove_reader(listener)
        for resumption in self._resumptions.values():
            resumption.cancel()
        self._connections.close_handshakes()
        await super().shutdown(sockets)

    def _accept(self, listener: socket.socket) -> None:
        """Accept connections; called by the event loop while any are in the backlog.

        `loop.sock_accept` raises InvalidStateError if cancelled in the turn in which one arrives.
        """
        try:
            for accepted in accept_pending(listener, _AT_ONCE):
                self._begin(accepted)
        except OSError as error:  # such as no free file descriptor
            self._connections.report(error.strerror or str(error))
            self._loop.remove_reader(listener)
            self._resumptions[listener] = self._loop.call_later(
                _PAUSE_S, self._loop.add_reader, listener, self._accept, listener
            )

    def _begin(self, accepted: socket.socket) -> None:
        try:
            connection = Connection(self.config, self.server_state, self._connections, accepted)
        except OSError:  # the peer is gone already
            accepted.close()
            return
        if not self._connections.admit(connection):
            accepted.close()
            return
        task = asyncio.create_task(self._open(connection, accepted))
        self._opening.add(task)
        task.add_done_callback(self._opening.discard)

    async def _open(self, connection: Connection, accepted: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        try:
            await loop.connect_accepted_socket(lambda: connection, accepted, **self._tls)
        except OSError:  # no TLS, or the handshake took too long
            self._connections.forget(connection)


def accept_pending(listener: socket.socket, most: int) -> Iterator[socket.socket]:
    """Accept at most ``most`` connections that are in the backlog. Raises OSError when a connection
    there cannot be accepted."""
    with contextlib.suppress(BlockingIOError, InterruptedError):
        for _ in range(most):
            yield listener.accept()[0]


@contextlib.contextmanager
def serving(
    app: ASGIApp,
    listener: socket.socket,
    tls: ssl.SSLContext | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> Iterator[int]:
    """Serve in a thread; yields the port. At the end requests under way are answered."""
    config = uvicorn.Config(
        app,
        loop="asyncio",
        http=Connection,
        ws="none",
        lifespan="auto",
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )
    server = _Server(config, Connections(RepeatFilter(note), MAX_CONNECTIONS), tls)
    listener.setblocking(False)
    listener.listen(_BACKLOG)  # from now on clients can connect
    port = int(listener.getsockname()[1])  # here: a server that ends closes its listener
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="http")
    thread.start()
    try:
        yield port
    finally:
        server.should_exit = True
        thread.join()
        listener.close()
