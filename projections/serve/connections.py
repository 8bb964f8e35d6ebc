"""HTTP connections that cannot be used against the service: uvicorn's, with limits.

uvicorn waits for a request for ever, on as many connections as the process may open. Here

* a request, head and body, must be complete ``REQUEST_S`` after its connection was opened or, on a
  connection that was used before, after its first byte; bytes that drip in do not extend that;
* an answer must have been read after ``ANSWER_S``, and all answers that wait to be read may hold
  ``MAX_UNREAD`` bytes;
* ``MAX_CONNECTIONS`` are open at most. A newcomer takes the place of one that waits for its peer:
  of the peer with the most connections the one that has waited longest. When all are being
  answered, the peer with the most loses its newest to one with fewer. So half-open ones give way,
  and whoever asks on very many at once, and honest clients get in.

A body must say its length: one sent in a million chunks would keep the event loop busy for seconds.
Refusals have the form of all others.
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
_LAST_WORDS_S: Final = 1.0
_MAX_SHOWN: Final = 200


class Connections:
    """Those that are open. ``tell`` gets a line for people for each one that is closed early."""

    def __init__(self, tell: Callable[[str], None], most: int) -> None:
        self._open: dict[Connection, None] = {}
        self._tell, self._most = tell, most

    def admit(self, newcomer: "Connection") -> bool:
        """Make room for a newcomer; False when all others are being answered, and no peer has more
        of them than the newcomer's."""
        if len(self._open) >= self._most:
            self._evict(newcomer.peer)
        if len(self._open) >= self._most:
            self.note(f"{self._most} were open, all being answered")
            return False
        self._open[newcomer] = None
        return True

    def forget(self, connection: "Connection") -> None:
        """It is closed."""
        self._open.pop(connection, None)

    def note(self, reason: str) -> None:
        """Tell why one is closed."""
        self._tell(f"http: closed a connection: {reason}")

    def drop(self, connection: "Connection", reason: str) -> None:
        """Close one at once, and tell why."""
        self.note(reason)
        self.forget(connection)
        connection.abort()

    def close_unmade(self) -> None:
        """Close those that are not made yet; of those uvicorn knows nothing."""
        for connection in [*self._open]:
            if not connection.is_made:
                connection.abort()

    def limit_unread(self) -> None:
        """Close those with the longest unread answers when all of these are too long."""
        unread = {connection: connection.unread for connection in self._open}
        while sum(unread.values()) > MAX_UNREAD:
            longest = max(unread, key=lambda connection: unread[connection])
            self.drop(longest, "its answer is long and was not read")
            del unread[longest]

    def _evict(self, newcomer: str) -> None:
        crowd = Counter(connection.peer for connection in self._open)
        waiting = [connection for connection in self._open if connection.waits_since is not None]
        if waiting:
            oldest = min(waiting, key=lambda c: (-crowd[c.peer], c.waits_since))
            self.drop(oldest, f"{self._most} were open, and it had no request under way")
            return
        heaviest, count = crowd.most_common(1)[0]
        if count > crowd[newcomer] + 1:
            newest = next(c for c in reversed(self._open) if c.peer == heaviest)
            self.drop(newest, f"{self._most} were open, all being answered, {count} for its peer")


class _Requests(h11.Connection):
    """h11's reading of requests; keeps why it could not read one."""

    fault: tuple[int, str] = (400, "not an HTTP request")

    def next_event(self) -> Any:
        try:
            event = super().next_event()
            _refuse_chunks(event)
        except h11.RemoteProtocolError as error:
            self.fault = error.error_status_hint, str(error)[:_MAX_SHOWN]
            raise
        return event


def _refuse_chunks(event: Any) -> None:
    if isinstance(event, h11.Request):
        for name, _ in event.headers:
            if name == b"transfer-encoding":
                raise h11.RemoteProtocolError("send a Content-Length instead of chunks", 411)


class Connection(H11Protocol):
    """One connection. ``waits_since`` is when its peer's turn began; None while we work."""

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
        """Bytes that wait for the peer to read."""
        return self.transport.get_write_buffer_size() if self.is_made else 0

    def abort(self) -> None:
        """Close at once, whatever it is at."""
        if self.is_made:
            self.transport.abort()
        else:  # in a TLS handshake, which then fails
            with contextlib.suppress(OSError):
                self._accepted.shutdown(socket.SHUT_RDWR)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """The peer may send."""
        super().connection_made(transport)
        self.is_made = True
        self._await_peer()

    def connection_lost(self, exc: Exception | None) -> None:
        """It is closed."""
        self._stop_timer()
        self._unset_keepalive_if_required()
        self._connections.forget(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes came."""
        if self._idle:
            self._await_peer()
        super().data_received(data)
        self._note_whose_turn_it_is()

    def on_response_complete(self) -> None:
        """The answer is written; maybe the next request is here already."""
        self._await_peer()
        self._connections.limit_unread()
        super().on_response_complete()
        self._note_whose_turn_it_is()

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  uvicorn's words say less
        """Refuse what is no request that h11 reads."""
        status, said = self._requests.fault
        self._refuse(status, said)

    def shutdown(self) -> None:
        """The service ends: what was not asked completely is not answered."""
        if self.waits_since is None:
            super().shutdown()
        else:
            self.abort()

    @property
    def _request(self) -> RequestResponseCycle | None:
        return self.cycle  # None at first, which uvicorn's types do not say

    @property
    def _idle(self) -> bool:
        request = self._request
        answered = request is not None and request.response_complete
        return answered and self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]

    def _note_whose_turn_it_is(self) -> None:
        request = self._request
        if request is not None and not request.more_body and not request.response_complete:
            self._stop_timer()
            self.waits_since = None

    def _await_peer(self) -> None:
        self._stop_timer()
        self.waits_since = time.monotonic()
        seconds = ANSWER_S if self.unread else REQUEST_S
        self._timer = self.loop.call_later(seconds, self._give_up)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _give_up(self) -> None:
        if self.unread or self._idle or self.transport.is_closing():
            self._connections.drop(self, f"no answer was read within {ANSWER_S:g} s")
            return
        self._connections.note(f"no complete request within {REQUEST_S:g} s")
        self._refuse(408, f"no complete request within {REQUEST_S:g} s")

    def _refuse(self, status: int, message: str) -> None:
        """Send a refusal if nothing was answered yet, and close."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            body = encode({"error": {"kind": "bad_question", "message": message}})
            headers = [
                ("content-type", "application/json"),
                ("content-length", str(len(body))),
                ("connection", "close"),
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
        self._timer = self.loop.call_later(_LAST_WORDS_S, self.transport.abort)


def peer_of(address: str) -> str:
    """Who is behind an address: of IPv6 a whole /64, which one peer has to itself."""
    found = ipaddress.ip_address(address.partition("%")[0])
    if found.version == 4:
        return address
    return str(found.ipv4_mapped or ipaddress.ip_network((found, 64), strict=False))
