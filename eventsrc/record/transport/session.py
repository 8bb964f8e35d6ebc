"""Zenoh sessions and a router. Only `eventsrc.record.transport` imports zenoh.

* Multicast scouting is off unless a configuration file turns it on: a recorder joins no network
  that it was not pointed at.
* A session does not listen, and a router listens on loopback only, unless an endpoint or a
  configuration file says otherwise.
* Shared memory is always off. Payloads over 3 kB would travel through it and can vanish with the
  process that owns the segment.
* A client receives into buffers of 4 MiB that it uses again, unless a configuration file says
  otherwise.
* Publishers are reliable and block. Zenoh's default drops messages silently when a queue is full.
* Subscribers are plain. Advanced ones drop a message with an earlier timestamp than one before it.
* A session is a context manager and is always closed. Every failure to open, declare or send is a
  TransportError of one line with the place and the next step. Zenoh's own log is silent unless
  ``RUST_LOG`` is set.
"""

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, Self

import zenoh

from eventsrc.base.errors import MisuseError

from .config import Mode, ZenohOptions, check_endpoints, configure
from .declarations import (
    CHANNEL_SIZE,
    BatchSubscription,
    Publisher,
    Query,
    ReadAttachment,
    Received,
    SequenceNumber,
    SizeLimit,
    Subscription,
    check_key_length,
    heartbeats_under,
    ignore_transport_errors,
    is_panic,
    one_line,
    open_error,
    parse_heartbeat,
    sequence_number,
    transport_errors,
)

__all__ = [
    "Mode",
    "Publisher",
    "Query",
    "Received",
    "SequenceNumber",
    "Session",
    "SizeLimit",
    "Subscription",
    "ZenohOptions",
    "check_keys",
    "open_session",
]

_CONFIRM_TIMEOUT_S: Final = 5.0


class Session:
    """An open Zenoh session. Make one with `open_session`; use it in a ``with`` block."""

    def __init__(self, raw: zenoh.Session) -> None:
        self.raw = raw
        """The zenoh.Session; not for use outside this package."""

    def publisher(self, key: str) -> Publisher:
        """Declare a publisher on ``key``."""
        return Publisher(self.raw, key)

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Received], None],
        limit: SizeLimit | None = None,
        *,
        in_order: bool = False,
        read_attachment: ReadAttachment | None = None,
    ) -> Subscription:
        """Call ``handler`` for every message under ``key_expr``, from a thread of Zenoh's.

        The handler must return quickly: nothing else is received meanwhile, and after five seconds
        Zenoh closes links and loses messages silently. Messages over ``limit`` are not copied out
        of Zenoh. Each subscription has a thread of its own; those ``in_order`` share the one that
        receives, so that messages of several keys come in the order in which they were sent.
        ``read_attachment`` finds publisher and number of messages that no advanced publisher sent.
        """

        def receive(sample: zenoh.Sample) -> None:
            payload = sample.payload  # each access makes a new object
            if limit is not None and len(payload) > limit.size_bytes:
                limit.refuse()
            else:
                key, number = str(sample.key_expr), sequence_number(sample, read_attachment)
                handler(Received(key, payload.to_bytes(), number))

        check_key_length(key_expr)
        with transport_errors(f"key expression {key_expr!r} cannot be subscribed to"):
            called = zenoh.handlers.Callback(receive, indirect=not in_order)
            return Subscription(self.raw.declare_subscriber(key_expr, called))

    def subscribe_batches(
        self, key_expr: str, handler: Callable[[list[Received]], None]
    ) -> Subscription:
        """Like `subscribe`, but call ``handler`` with all messages received since its last call, in
        order. For high rates, at which a call for each message would slow down other threads."""
        check_key_length(key_expr)
        with transport_errors(f"key expression {key_expr!r} cannot be subscribed to"):
            channel: zenoh.handlers.FifoChannel[zenoh.Sample]
            channel = zenoh.handlers.FifoChannel(CHANNEL_SIZE)
            subscriber = self.raw.declare_subscriber(key_expr, channel)
        return BatchSubscription(subscriber, handler)

    def subscribe_heartbeats(
        self, key_expr: str, handler: Callable[[SequenceNumber], None]
    ) -> Subscription:
        """Call ``handler`` with the last number of an advanced publisher under ``key_expr`` at each
        of its heartbeats; like `subscribe` from a thread of Zenoh's."""

        def receive(sample: zenoh.Sample) -> None:
            number = parse_heartbeat(sample)
            if number is not None:
                handler(number)

        expression = heartbeats_under(key_expr)
        check_key_length(expression)
        with transport_errors(f"key expression {expression!r} cannot be subscribed to"):
            return Subscription(self.raw.declare_subscriber(expression, receive))

    def subscribe_tokens(self, key_expr: str, handler: Callable[[str], None]) -> Subscription:
        """Call ``handler`` with the key of every liveliness token under ``key_expr``, those that
        are there already included; like `subscribe` from a thread of Zenoh's."""

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                handler(str(sample.key_expr))

        check_key_length(key_expr)
        with transport_errors(f"key expression {key_expr!r} cannot be subscribed to"):
            return Subscription(
                self.raw.liveliness().declare_subscriber(key_expr, receive, history=True)
            )

    def declare_token(self, key: str) -> Subscription:
        """Declare a liveliness token, which others see until it or the session is closed."""
        check_key_length(key)
        with transport_errors(f"token {key!r} cannot be declared"):
            return Subscription(self.raw.liveliness().declare_token(key))

    @property
    def id(self) -> str:
        """The session's id, new for each session."""
        return str(self.raw.zid())

    def tokens(self, key_expr: str, *, timeout_s: float) -> list[str]:
        """The keys of all liveliness tokens under ``key_expr``."""
        check_key_length(key_expr)
        with transport_errors(f"key expression {key_expr!r} cannot be queried"):
            replies = self.raw.liveliness().get(key_expr, timeout=timeout_s)
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def cached(
        self,
        selector: str,
        *,
        timeout_s: float,
        most: int,
        read_attachment: ReadAttachment | None = None,
    ) -> Iterator[Received]:
        """The messages that caches reply to ``selector``, each under its own key, as they come; at
        most ``most``. They have numbers only by ``read_attachment``."""
        check_key_length(selector)
        with transport_errors(f"selector {selector!r} cannot be queried"):
            replies = self.raw.get(selector, timeout=timeout_s)
        samples = (reply.ok for reply in replies)
        for sample in itertools.islice((sample for sample in samples if sample is not None), most):
            number = None
            if read_attachment is not None:
                number = sequence_number(sample, read_attachment)
            yield Received(str(sample.key_expr), sample.payload.to_bytes(), number)

    def send(self, key: str, payload: bytes) -> None:
        """Send one message without blocking; it is dropped if the network is full."""
        check_key_length(key)
        with transport_errors(f"key {key!r}: not sent"):
            self.raw.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def put(self, key: str, payload: bytes) -> None:
        """Send one message under a key that is used once, reliably; blocks while the network is
        full."""
        check_key_length(key)
        with transport_errors(f"key {key!r}: not sent"):
            self.raw.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def confirm(self) -> None:
        """Return when the router or peer has processed everything declared so far.

        It sends a query without a reply. The query follows the declarations on the same
        link, so when it ends, they have been read.
        """
        self.get(f"mapfold/confirm/{self.raw.zid()}", timeout_s=_CONFIRM_TIMEOUT_S)

    def get(self, selector: str, payload: bytes | None = None, *, timeout_s: float) -> list[bytes]:
        """Query every queryable under ``selector``; the payloads of the good replies."""
        replies = self.get_replies(selector, payload, timeout_s=timeout_s)
        return [reply for good, reply in replies if good]

    def queryable(self, key: str, handler: Callable[[Query], None]) -> Subscription:
        """Call ``handler`` for every query under ``key``, from a thread of Zenoh's; it must return
        quickly."""

        def receive(query: zenoh.Query) -> None:
            handler(Query(query))

        with transport_errors(f"key {key!r} cannot be answered on"):
            return Subscription(self.raw.declare_queryable(key, receive, complete=True))

    def get_replies(
        self, selector: str, payload: bytes | None = None, *, timeout_s: float
    ) -> list[tuple[bool, bytes]]:
        """Like `get`, with the errors: (True, payload) or (False, error) for each reply."""
        check_key_length(selector)
        with transport_errors(f"selector {selector!r} cannot be queried"):
            return [
                (True, reply.ok.payload.to_bytes())
                if reply.ok is not None
                else (False, reply.err.payload.to_bytes() if reply.err is not None else b"")
                for reply in self.raw.get(selector, payload=payload, timeout=timeout_s)
            ]

    @property
    def is_connected(self) -> bool:
        """Whether at least one router or peer is connected."""
        return bool(self.raw.info.transports())

    @property
    def locators(self) -> list[str]:
        """The endpoints a router session listens on, with the actual ports."""
        for document in self.get(f"@/{self.raw.zid()}/router", timeout_s=_CONFIRM_TIMEOUT_S):
            return [str(locator) for locator in json.loads(document)["locators"]]
        return []

    def close(self) -> None:
        """Undeclare everything and close. May be called twice."""
        with ignore_transport_errors():
            self.raw.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_keys(key_exprs: Sequence[str]) -> None:
    """Raise MisuseError if one is malformed, or two overlap: messages under both come twice."""
    parsed = []
    for text in key_exprs:
        try:
            parsed.append(zenoh.KeyExpr(text))
        except zenoh.ZError as error:
            raise MisuseError(f"key expression {text!r}: {one_line(error)}") from None
        except UnicodeEncodeError:
            raise MisuseError(f"key expression {text!r}: not UTF-8 text") from None
    for one, other in itertools.combinations(parsed, 2):
        if one.intersects(other):
            raise MisuseError(
                f"key expressions {str(one)!r} and {str(other)!r} overlap: messages that match "
                "both would be received twice; give the wider one alone"
            )


def check_options(options: ZenohOptions) -> None:
    """Raise MisuseError where `open_session` would, without connecting."""
    check_endpoints((*options.connect, *options.listen))
    _config_from_file(options.config_file)


def open_session(options: ZenohOptions, *, mode: Mode) -> Session:
    """Open a session.

    Raises MisuseError when ``options`` are wrong in themselves, TransportError when it cannot
    connect or listen as asked.
    """
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    config = _config_from_file(options.config_file)
    configure(config, zenoh.Config(), options, mode)
    connect, listen = config.get_json("connect/endpoints"), config.get_json("listen/endpoints")
    try:
        return Session(zenoh.open(config))
    except BaseException as error:
        if isinstance(error, zenoh.ZError) or is_panic(error):
            raise open_error(error, json.loads(connect), json.loads(listen)) from None
        raise


def _config_from_file(path: Path | None) -> zenoh.Config:
    if path is None:
        return zenoh.Config()
    if not path.is_file():
        raise MisuseError(f"{path}: no such Zenoh configuration file; check --zenoh-config")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise MisuseError(f"{path}: not a Zenoh configuration: {one_line(error)}") from None


class Router:
    """A running router: ``with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router: …``.

    It runs in this process. ``endpoints`` are those it listens on; port 0 takes a free port, and
    ``endpoints`` has its number. Raises TransportError if it cannot listen.
    """

    def __init__(self, options: ZenohOptions) -> None:
        self._session = open_session(options, mode="router")
        self.endpoints = tuple(self._session.locators)

    def close(self) -> None:
        """Stop routing and free the port. May be called twice."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
