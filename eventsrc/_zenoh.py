"""The one door to Zenoh: nothing else in mapfold imports it.

What holds behind this door:

* Multicast scouting is off unless a configuration file turns it on: a recorder never joins a
  network it was not pointed at.
* Shared memory is off, always. Payloads over 3 kB would travel through it and can vanish with the
  process that owns the segment.
* Publishers are reliable and block. Zenoh's default drops when a queue is full, and says nothing.
* A session is a context manager and is always closed. Every failure to open, declare or send is a
  TransportError of one line that says where and what to do; Zenoh's own log is silent unless
  ``RUST_LOG`` asks for it.
"""

import contextlib
import itertools
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import zenoh

from ._zenoh_config import Mode, ZenohOptions, configure
from ._zenoh_errors import cannot_open, plain
from .endpoints import check_endpoints
from .errors import MisuseError, TransportError

__all__ = [
    "Asked",
    "Missed",
    "Mode",
    "Publisher",
    "Received",
    "Session",
    "Subscription",
    "ZenohOptions",
    "check_keys",
    "open_session",
]

_CONFIRM_TIMEOUT_S: Final = 5.0
_HEARTBEAT_S: Final = 0.5


class Received(NamedTuple):
    """One message. Zenoh's own timestamp is left out: it may be missing, nothing goes by it, and
    thousands a second would have to be read."""

    key: str
    payload: bytes


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
        with contextlib.suppress(zenoh.ZError):  # who asked may be gone: nobody is left to tell
            send()
        self._query.drop()  # type: ignore[no-untyped-call]
        self.ended = True


class Publisher:
    """Sends bytes under one key: reliable, in order, blocking while the network is full.

    An ``advanced`` one also numbers its messages and keeps the last ``cache`` of them, so that a
    subscriber notices what it missed and can fetch it.
    """

    def __init__(self, session: "Session", key: str, *, advanced: bool, cache: int) -> None:
        self.key = key
        declare = _declare_advanced if advanced else _declare_plain
        with _clear_errors(f"key {key!r} cannot be published to"):
            self._sender = declare(session.raw, key, cache)
            # An advanced publisher cannot say whether anybody listens; a plain one beside it can.
            self._watch = session.raw.declare_publisher(key) if advanced else self._sender

    def put(self, payload: bytes) -> None:
        """Send. Returns when Zenoh has taken it, which is not yet when anybody has received it."""
        with _clear_errors(f"key {self.key!r}: not sent"):
            self._sender.put(payload)

    @property
    def has_subscriber(self) -> bool:
        """Whether somebody subscribes to this key now, as far as this session knows."""
        with _clear_errors(f"key {self.key!r}: the session is gone"):
            status: Any = self._watch.matching_status  # typed bool in zenoh's stubs, but it is none
            return bool(status.matching)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes to this key; False when nobody did in time."""
        matched = threading.Event()
        with _clear_errors(f"key {self.key!r}: the session is gone"):
            listener = self._watch.declare_matching_listener(
                lambda status: matched.set() if status.matching else None
            )
        try:
            return self.has_subscriber or matched.wait(timeout_s)
        finally:
            listener.undeclare()

    def close(self) -> None:
        """Stop publishing under this key."""
        with contextlib.suppress(zenoh.ZError):
            self._sender.undeclare()
            if self._watch is not self._sender:
                self._watch.undeclare()


class Subscription:
    """A declared subscription. Closing it, or its session, ends the calls."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Stop receiving."""
        with contextlib.suppress(zenoh.ZError):
            for entity in self._declared:
                entity.undeclare()


class Session:
    """An open Zenoh session. Make one with `open_session`; use it in a ``with`` block."""

    def __init__(self, raw: zenoh.Session) -> None:
        self.raw = raw
        """Zenoh's own object; for this module and nobody else."""

    def publisher(self, key: str, *, advanced: bool = False, cache: int = 1_000) -> Publisher:
        """Declare a publisher on ``key``."""
        return Publisher(self, key, advanced=advanced, cache=cache)

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Received], None],
        on_miss: Callable[[Missed], None] | None = None,
    ) -> Subscription:
        """Call ``handler`` for every message under ``key_expr``, from a thread of Zenoh's.

        The handler must only hand over: while it works nothing else is received, and after five
        seconds of that Zenoh gives up links and loses messages without a word. With ``on_miss``
        gaps in what advanced publishers send are fetched again, and told of if that fails.
        """

        def receive(sample: zenoh.Sample) -> None:
            handler(_received(sample))

        with _clear_errors(f"key expression {key_expr!r} cannot be subscribed to"):
            if on_miss is None:
                return Subscription(self.raw.declare_subscriber(key_expr, receive))
            return _subscribe_advanced(self.raw, key_expr, receive, on_miss)

    def send(self, key: str, payload: bytes) -> None:
        """Send one message that may be dropped if the network is full; never blocks on it."""
        with _clear_errors(f"key {key!r}: not sent"):
            self.raw.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def confirm(self) -> None:
        """Return when the other end has taken in everything declared so far.

        A question that nobody answers travels the same way as the declarations before it; when
        the router says there is no answer, it has read those too.
        """
        self.get(f"mapfold/confirm/{self.raw.zid()}", timeout_s=_CONFIRM_TIMEOUT_S)

    def get(self, selector: str, payload: bytes | None = None, *, timeout_s: float) -> list[bytes]:
        """Ask everybody who answers under ``selector``; the payloads of the good answers."""
        answers = self.ask(selector, payload, timeout_s=timeout_s)
        return [answer for good, answer in answers if good]

    def questions(self, key: str, take: Callable[[Asked], None]) -> Subscription:
        """Hand over every question under ``key`` to ``take``, which must not work on it itself."""

        def hand_over(query: zenoh.Query) -> None:
            take(Asked(query))

        with _clear_errors(f"key {key!r} cannot be answered on"):
            return Subscription(self.raw.declare_queryable(key, hand_over, complete=True))

    def ask(
        self, selector: str, payload: bytes | None = None, *, timeout_s: float
    ) -> list[tuple[bool, bytes]]:
        """Like `get`, with the refusals: (True, answer) and (False, error) as they came."""
        with _clear_errors(f"selector {selector!r} cannot be asked"):
            return [
                (True, reply.ok.payload.to_bytes())
                if reply.ok is not None
                else (False, reply.err.payload.to_bytes() if reply.err is not None else b"")
                for reply in self.raw.get(selector, payload=payload, timeout=timeout_s)
            ]

    @property
    def linked(self) -> bool:
        """Whether at least one router or peer is connected now."""
        return bool(self.raw.info.transports())

    @property
    def locators(self) -> list[str]:
        """Where a router session listens, with the ports it really got."""
        for document in self.get(f"@/{self.raw.zid()}/router", timeout_s=_CONFIRM_TIMEOUT_S):
            return [str(locator) for locator in json.loads(document)["locators"]]
        return []

    def close(self) -> None:
        """Undeclare everything and close. May be called twice."""
        with contextlib.suppress(zenoh.ZError):
            self.raw.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()


def check_keys(key_exprs: Sequence[str]) -> None:
    """Raise MisuseError if one is malformed or two overlap: a message under both comes twice."""
    parsed = []
    for text in key_exprs:
        try:
            parsed.append(zenoh.KeyExpr(text))
        except zenoh.ZError as error:
            raise MisuseError(f"key expression {text!r}: {plain(error)}") from None
    for one, other in itertools.combinations(parsed, 2):
        if one.intersects(other):
            raise MisuseError(
                f"key expressions {str(one)!r} and {str(other)!r} overlap: what matches both would "
                "come twice; give the wider one alone"
            )


def check_options(options: ZenohOptions) -> None:
    """Raise MisuseError for what `open_session` would refuse wherever the network is."""
    check_endpoints((*options.connect, *options.listen))
    _config_from_file(options.config_file)


def open_session(options: ZenohOptions, *, mode: Mode) -> Session:
    """Open a session.

    Raises MisuseError when ``options`` are wrong in themselves, TransportError when it cannot
    connect or listen as asked.
    """
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    config = _config_from_file(options.config_file)
    configure(config, options, mode)
    connect, listen = config.get_json("connect/endpoints"), config.get_json("listen/endpoints")
    try:
        return Session(zenoh.open(config))
    except zenoh.ZError as error:
        raise cannot_open(error, json.loads(connect), json.loads(listen)) from None


def _config_from_file(path: Path | None) -> zenoh.Config:
    if path is None:
        return zenoh.Config()
    if not path.is_file():
        raise MisuseError(f"{path}: no such Zenoh configuration file; check --zenoh-config")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise MisuseError(f"{path}: not a Zenoh configuration: {plain(error)}") from None


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


def _subscribe_advanced(
    session: zenoh.Session,
    key_expr: str,
    receive: Callable[[zenoh.Sample], None],
    on_miss: Callable[[Missed], None],
) -> Subscription:
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


def _received(sample: zenoh.Sample) -> Received:
    return Received(str(sample.key_expr), sample.payload.to_bytes())


@contextlib.contextmanager
def _clear_errors(place: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"{place}: {plain(error)}") from None
