"""What is declared on a Zenoh session: publishers, subscriptions, questions. A part of the door,
`eventsrc._zenoh`, through which everybody else gets them; the rules stand there.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import zenoh

from ._zenoh_errors import is_panic, plain
from .errors import TransportError

_HEARTBEAT_S: Final = 0.5
_MOST_KEY_BYTES: Final = 16 * 1024
"""Zenoh panics when a key does not fit one batch of 64 KiB beside what else stands in it."""


class Received(NamedTuple):
    """One message. Zenoh's own timestamp is left out: it may be missing, nothing goes by it, and
    thousands a second would have to be read."""

    key: str
    payload: bytes


class Bound(NamedTuple):
    """Messages over ``size_bytes`` are not taken; ``refuse`` is called with the key of each."""

    size_bytes: int
    refuse: Callable[[str], None]


class Missed(NamedTuple):
    """``missed`` messages of the advanced publisher ``source`` never came nor can be fetched."""

    source: str
    missed: int


class Asked:
    """A question under a queryable. Answer or refuse it once, from any thread; that ends it.

    ``key`` is what was asked, which may hold wildcards; ``parameters`` stand behind its ``?``.
    """

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self.key = str(query.key_expr)
        self.parameters = _parameters(str(query.parameters))
        self.payload = query.payload.to_bytes() if query.payload is not None else b""
        self.ended = False

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
    """Sends bytes under one key: reliable, in order, blocking while the network is full.

    An ``advanced`` one also numbers its messages and keeps the last ``cache`` of them, so that a
    subscriber notices what it missed and can fetch it.
    """

    def __init__(self, session: zenoh.Session, key: str, *, advanced: bool, cache: int) -> None:
        check_key_length(key)
        self.key = key
        declare = _declare_advanced if advanced else _declare_plain
        with clear_errors(f"key {key!r} cannot be published to"):
            self._sender = declare(session, key, cache)
            # An advanced publisher cannot say whether anybody listens; a plain one beside it can.
            self._watch = session.declare_publisher(key) if advanced else self._sender

    def put(self, payload: bytes) -> None:
        """Send. Returns when Zenoh has taken it, which is not yet when anybody has received it."""
        with clear_errors(f"key {self.key!r}: not sent"):
            self._sender.put(payload)

    @property
    def has_subscriber(self) -> bool:
        """Whether somebody subscribes to this key now, as far as this session knows."""
        with clear_errors(f"key {self.key!r}: the session is gone"):
            status: Any = self._watch.matching_status  # typed bool in zenoh's stubs, but it is none
            return bool(status.matching)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes to this key; False when nobody did in time."""
        matched = threading.Event()
        with clear_errors(f"key {self.key!r}: the session is gone"):
            listener = self._watch.declare_matching_listener(
                lambda status: matched.set() if status.matching else None
            )
        try:
            return self.has_subscriber or matched.wait(timeout_s)
        finally:
            listener.undeclare()

    def close(self) -> None:
        """Stop publishing under this key."""
        with quietly():
            self._sender.undeclare()
            if self._watch is not self._sender:
                self._watch.undeclare()


class Subscription:
    """A declared subscription. Closing it, or its session, ends the calls."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Stop receiving."""
        with quietly():
            for entity in self._declared:
                entity.undeclare()


def _declare_plain(session: zenoh.Session, key: str, _: int) -> Any:
    return session.declare_publisher(
        key,
        congestion_control=zenoh.CongestionControl.BLOCK,
        reliability=zenoh.Reliability.RELIABLE,
    )


def _declare_advanced(session: zenoh.Session, key: str, cache: int) -> Any:
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=zenoh.CongestionControl.BLOCK,
        reliability=zenoh.Reliability.RELIABLE,
        cache=zenoh.ext.CacheConfig(cache),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(
            heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S
        ),
        publisher_detection=True,
    )


def subscribe_advanced(
    session: zenoh.Session,
    key_expr: str,
    receive: Callable[[zenoh.Sample], None],
    on_miss: Callable[[Missed], None],
) -> Subscription:
    """A subscription that fetches again what it missed, and tells of it where that fails."""
    subscriber = zenoh.ext.declare_advanced_subscriber(
        session,
        key_expr,
        receive,
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
    listener = subscriber.sample_miss_listener(
        lambda miss: on_miss(Missed(f"{miss.source.zid}:{miss.source.eid}", miss.nb))
    )
    return Subscription(listener, subscriber)


def _parameters(text: str) -> dict[str, str]:
    """Zenoh writes them ``name=value;name=value``."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def received(sample: zenoh.Sample) -> Received:
    """What we take of a message."""
    return Received(str(sample.key_expr), sample.payload.to_bytes())


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
