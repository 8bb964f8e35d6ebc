"""uvicorn's HTTP connections with limits on their number, time and memory.

uvicorn waits for a request forever, on as many connections as the process may open. Here

* a request, head and body, must be complete ``REQUEST_S`` after its connection was opened or, on a
  connection that was used before, after its first byte; single bytes do not extend that;
* an answer must have been read after ``ANSWER_S``, and all unread answers together may have
  ``MAX_UNREAD`` bytes;
* at most ``MAX_CONNECTIONS`` are open. When they are, a new one replaces one without a complete
  request: of the peer with the most connections the one that has waited longest. When all are
  being answered, the peer with the most loses its newest to a peer with fewer. So half-open
  connections and peers with very many do not keep others out.

A body needs a Content-Length: one sent in a million chunks would keep the event loop busy for
seconds. Refusals have the same JSON form as all others.
"""

import asyncio
import contextlib
import ipaddress
import socket
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import h11
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.server import ServerState

from .answering import encode

MAX_CONNECTIONS: Final = 128
MAX_UNREAD: Final = 64 * 1024 * 1024
MAX_HEAD: Final = 16 * 1024
REQUEST_S: Final = 10.0
ANSWER_S: Final = 60.0
_CLOSE_S: Final = 1.0
_MAX_SHOWN: Final = 200
_NO_LENGTH: Final = "send a Content-Length instead of chunks"


class Connections:
    """The open connections. ``note`` gets a line for people for each one that is closed early."""

    def __init__(self, note: Callable[[str], None], most: int) -> None:
        self._open: dict[Connection, None] = {}
        self._note, self._most = note, most

    def admit(self, newcomer: "Connection") -> bool:
        """Add a new connection, if need be in place of another; False when all others are being
        answered and no peer has more connections than the newcomer's."""
        if len(self._open) >= self._most:
            self._evict(newcomer.peer)
        if len(self._open) >= self._most:
            self.report(f"{self._most} were open, all being answered")
            return False
        self._open[newcomer] = None
        return True

    def forget(self, connection: "Connection") -> None:
        """Remove a closed connection."""
        self._open.pop(connection, None)

    def report(self, reason: str) -> None:
        """Report why a connection is closed."""
        self._note(f"http: closed a connection: {reason}")

    def drop(self, connection: "Connection", reason: str) -> None:
        """Close a connection at once, and report why."""
        self.report(reason)
        self.forget(connection)
        connection.abort()

    def close_handshakes(self) -> None:
        """Close those in a TLS handshake, which uvicorn does not track."""
        for connection in [*self._open]:
            if not connection.is_made:
                connection.abort()

    def limit_unread(self) -> None:
        """Close those with the longest unread answers while all together exceed ``MAX_UNREAD``."""
        unread = {connection: connection.unread for connection in self._open}
        while sum(unread.values()) > MAX_UNREAD:
            longest = max(unread, key=lambda connection: unread[connection])
            self.drop(longest, "its answer is long and was not read")
            del unread[longest]

    def _evict(self, newcomer: str) -> None:
        per_peer = Counter(connection.peer for connection in self._open)
        waiting = [connection for connection in self._open if connection.waits_since is not None]
        if waiting:
            oldest = min(waiting, key=lambda c: (-per_peer[c.peer], c.waits_since))
            self.drop(oldest, f"{self._most} were open, and it had no request under way")
            return
        heaviest, count = per_peer.most_common(1)[0]
        if count > per_peer[newcomer] + 1:
            newest = next(c for c in reversed(self._open) if c.peer == heaviest)
            self.drop(newest, f"{self._most} were open, all being answered, {count} for its peer")


class _Requests(h11.Connection):
    """h11's parser of requests, which keeps the status and the reason of a refusal."""

    fault: tuple[int, str] = (400, "not an HTTP request")

    def next_event(self) -> Any:
        try:
            event = super().next_event()
            _refuse_chunks(event)
        except h11.RemoteProtocolError as error:
            self.fault = error.error_status_hint, str(error)[:_MAX_SHOWN]
            if error.error_status_hint == 501:  # an encoding that is not chunked
                self.fault = 411, _NO_LENGTH
            raise
        return event


def _refuse_chunks(event: Any) -> None:
    if isinstance(event, h11.Request):
        for name, _ in event.headers:
            if name == b"transfer-encoding":
                raise h11.RemoteProtocolError(_NO_LENGTH, 411)


class Connection(H11Protocol):
    """One connection. ``waits_since`` is the time since which it waits for its peer; None while a
    request is being answered."""

    def __init__(
        self, config: Config, state: ServerState, connections: Connections, accepted: socket.socket
    ) -> None:
        super().__init__(config=config, server_state=state, app_state={})
        self.conn = self._requests = _Requests(h11.SERVER, MAX_HEAD)
        self.peer = peer_of(accepted.getpeername()[0])
        self.waits_since: float | None = time.monotonic()
        self._connections, self._accepted = connections, accepted
        self._timer: asyncio.TimerHandle | None = None
        self.is_made = False

    @property
    def unread(self) -> int:
        """Bytes written that the peer has not read."""
        return self.transport.get_write_buffer_size() if self.is_made else 0

    def abort(self) -> None:
        """Close at once, in any state."""
        if self.is_made:
            self.transport.abort()
        else:  # in a TLS handshake, which then fails
            with contextlib.suppress(OSError):
                self._accepted.shutdown(socket.SHUT_RDWR)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Called by asyncio when the connection is ready (with TLS: after the handshake)."""
        super().connection_made(transport)
        self.is_made = True
        self._await_peer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by asyncio when the connection is closed."""
        self._stop_timer()
        self._unset_keepalive_if_required()
        self._connections.forget(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Called by asyncio with received bytes."""
        if self._idle:
            self._await_peer()
        super().data_received(data)
        self._update_waits_since()

    def on_response_complete(self) -> None:
        """Called by uvicorn when an answer is written; the next request may be here already."""
        self._await_peer()
        self._connections.limit_unread()
        super().on_response_complete()
        self._update_waits_since()

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  h11's reason says more
        """Called by uvicorn for a request that h11 cannot parse: refuse it."""
        self._refuse(*self._requests.fault)

    def shutdown(self) -> None:
        """Called by uvicorn at the end of the service: incomplete requests are not answered."""
        if self.waits_since is None:
            super().shutdown()
        else:
            self.abort()

    @property
    def _request(self) -> RequestResponseCycle | None:
        return self.cycle  # None at first, unlike its type in uvicorn

    @property
    def _idle(self) -> bool:
        request = self._request
        answered = request is not None and request.response_complete
        return answered and self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]

    def _update_waits_since(self) -> None:
        request = self._request
        if request is not None and not request.more_body and not request.response_complete:
            self._stop_timer()
            self.waits_since = None

    def _await_peer(self) -> None:
        self._stop_timer()
        self.waits_since = time.monotonic()
        seconds = ANSWER_S if self.unread else REQUEST_S
        self._timer = self.loop.call_later(seconds, self._time_out)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _time_out(self) -> None:
        if self.unread or self._idle or self.transport.is_closing():
            self._connections.drop(self, f"no answer was read within {ANSWER_S:g} s")
            return
        self._connections.report(f"no complete request within {REQUEST_S:g} s")
        self._refuse(408, f"no complete request within {REQUEST_S:g} s")

    def _refuse(self, status: int, message: str) -> None:
        """Send a refusal, if no response has started, and close."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            body = encode({"error": {"kind": "bad_question", "message": message}})
            headers = [
                ("content-type", "application/json"),
                ("content-length", str(len(body))),
                ("connection", "close"),
                ("content-security-policy", "default-src 'none'; frame-ancestors 'none'"),
                ("x-content-type-options", "nosniff"),
            ]
            for event in (
                h11.Response(status_code=status, headers=headers),
                h11.Data(data=body),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        if (request := self._request) is not None:
            request.disconnected = True  # the application must not answer too
        self.transport.close()
        self._stop_timer()
        self._timer = self.loop.call_later(_CLOSE_S, self.transport.abort)


def peer_of(address: str) -> str:
    """The peer of an address: the address itself, or of IPv6 its /64, which one peer has."""
    found = ipaddress.ip_address(address.partition("%")[0])
    if found.version == 4:
        return address
    return str(found.ipv4_mapped or ipaddress.ip_network((found, 64), strict=False))
