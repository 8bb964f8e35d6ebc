"""What is declared on a Zenoh session: publishers, subscriptions, questions. A part of the door,
`eventsrc.transport.session`, through which everybody else gets them; the rules stand there.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import zenoh

from eventsrc.errors import TransportError

from .config import is_panic, plain

_MOST_KEY_BYTES: Final = 16 * 1024
"""Zenoh panics when a key does not fit one batch of 64 KiB beside what else stands in it."""
_HEARTBEATS: Final = "@adv/pub/"
"""What stands between a key and the session and entity id of an advanced publisher under it."""
_NUMBER_BYTES: Final = 4


class Number(NamedTuple):
    """The number ``value`` (32 bits, then 0 again) that ``source`` has given to a message.

    Zenoh's advanced publishers number their messages; ``source`` is ``<session id>:<entity id>``.
    """

    source: str
    value: int


class Received(NamedTuple):
    """One message, with its publisher's number if it has one. Zenoh's timestamp is not read: it
    may be missing, equal to another or earlier than the one before, and nothing depends on it."""

    key: str
    payload: bytes
    number: Number | None = None


class Bound(NamedTuple):
    """Messages over ``size_bytes`` are not taken; ``refuse`` is called with the key of each and its
    publisher's number, if it has one."""

    size_bytes: int
    refuse: Callable[[str, Number | None], None]


class Asked:
    """A question under a queryable. Answer or refuse it once, from any thread; that ends it.

    ``key`` is what was asked, which may hold wildcards. ``size`` and ``selector_size`` are the
    bytes of the payload and of the key with its parameters, known before any of them is read.
    """

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self.key = str(query.key_expr)
        self.size = len(query.payload) if query.payload is not None else 0
        self.selector_size = len(str(query.selector))
        self.ended = False

    @property
    def parameters(self) -> dict[str, str]:
        """What stands behind the ``?`` of the selector."""
        return _parameters(str(self._query.parameters))

    @property
    def payload(self) -> bytes:
        """A copy of what came with the question."""
        return self._query.payload.to_bytes() if self._query.payload is not None else b""

    def answer(self, key: str, payload: bytes) -> None:
        """Send the answer, under ``key``."""
        self._end(lambda: self._query.reply(key, payload))

    def refuse(self, payload: bytes) -> None:
        """Send an error instead of an answer."""
        self._end(lambda: self._query.reply_err(payload))

    def _end(self, send: Callable[[], None]) -> None:
        with quietly():  # who asked may be gone: nobody is left to tell
            send()
        self._query.drop()  # type: ignore[no-untyped-call]
        self.ended = True


class Publisher:
    """Sends bytes under one key: reliable, in order, blocking while the network is full."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        check_key_length(key)
        self.key = key
        self.departures = 0
        """How often the last subscriber has left."""
        with clear_errors(f"key {key!r} cannot be published to"):
            self._sender: Any = session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
            )
            self._listener: Any = self._sender.declare_matching_listener(self._note)

    def _note(self, status: Any) -> None:
        self.departures += not status.matching

    def put(self, payload: bytes) -> None:
        """Send. Returns when Zenoh has taken it, which is not yet when anybody has received it."""
        with clear_errors(f"key {self.key!r}: not sent"):
            self._sender.put(payload)

    @property
    def has_subscriber(self) -> bool:
        """Whether somebody subscribes to this key now, as far as this session knows."""
        with clear_errors(f"key {self.key!r}: the session is gone"):
            status: Any = self._sender.matching_status  # its stubs say bool, which it is not
            return bool(status.matching)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes to this key; False when nobody did in time."""
        matched = threading.Event()
        with clear_errors(f"key {self.key!r}: the session is gone"):
            listener = self._sender.declare_matching_listener(
                lambda status: matched.set() if status.matching else None
            )
        try:
            return self.has_subscriber or matched.wait(timeout_s)
        finally:
            listener.undeclare()

    def close(self) -> None:
        """Stop publishing under this key."""
        with quietly():
            self._listener.undeclare()
            self._sender.undeclare()


class Subscription:
    """A declared subscription. Closing it, or its session, ends the calls."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Stop receiving."""
        with quietly():
            for entity in self._declared:
                entity.undeclare()


def _parameters(text: str) -> dict[str, str]:
    """Zenoh writes them ``name=value;name=value``."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def received(sample: zenoh.Sample) -> Received:
    """What we take of a message."""
    return Received(str(sample.key_expr), sample.payload.to_bytes(), number_of(sample))


def number_of(sample: zenoh.Sample) -> Number | None:
    """The number that an advanced publisher gave to ``sample``."""
    info = sample.source_info
    if info is None:
        return None
    return Number(f"{info.source_id.zid}:{info.source_id.eid}", info.source_sn)


def heartbeats_under(key_expr: str) -> str:
    """The key expression of the heartbeats of all advanced publishers under ``key_expr``."""
    return f"{key_expr}/{_HEARTBEATS}**"


def heartbeat(sample: zenoh.Sample) -> Number | None:
    """The last number its publisher has given, if ``sample`` is a heartbeat as we know them."""
    source = str(sample.key_expr).rpartition(_HEARTBEATS)[2].split("/")
    if len(source) < 2 or len(sample.payload) != _NUMBER_BYTES:
        return None
    return Number(":".join(source[:2]), int.from_bytes(sample.payload.to_bytes(), "little"))


@contextlib.contextmanager
def clear_errors(place: str) -> Iterator[None]:
    """Whatever Zenoh raises as a TransportError that says ``place``. A panic, after which the
    session may be of no more use, says so."""
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"{place}: {plain(error)}") from None
    except BaseException as error:
        if not is_panic(error):
            raise
        raise TransportError(f"{place}: Zenoh failed inside: {plain(error)}") from None


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Ending something whatever Zenoh raises: what is told nobody can act on."""
    with contextlib.suppress(TransportError), clear_errors("ending"):
        yield


def check_key_length(key: str) -> None:
    """TransportError for a key that Zenoh would fail inside on, and the session with it."""
    size = len(key.encode())
    if size > _MOST_KEY_BYTES:
        raise TransportError(
            f"key {key[:80]!r}…: {size:,} bytes are more than {_MOST_KEY_BYTES:,}; choose a shorter"
        )
