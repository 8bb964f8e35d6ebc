"""The one door to Zenoh: but for its own parts, nothing else in mapfold imports it.

What holds behind this door:

* Multicast scouting is off unless a configuration file turns it on: a recorder never joins a
  network it was not pointed at.
* A session listens nowhere, and a router on loopback only, unless told otherwise: by an endpoint or
  by a configuration file.
* Shared memory is off, always. Payloads over 3 kB would travel through it and can vanish with the
  process that owns the segment.
* Publishers are reliable and block. Zenoh's default drops when a queue is full, and says nothing.
* Subscribers are plain. Advanced ones drop what bears an earlier timestamp than a message before.
* A session is a context manager and is always closed. Every failure to open, declare or send is a
  TransportError of one line that says where and what to do; Zenoh's own log is silent unless
  ``RUST_LOG`` asks for it.

A Zenoh router inside this process, so that nothing else need be installed.
"""

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import zenoh

from eventsrc.errors import MisuseError

from .config import Mode, ZenohOptions, cannot_open, check_endpoints, configure, is_panic, plain
from .declarations import (
    Asked,
    Bound,
    Number,
    Publisher,
    Received,
    Subscription,
    check_key_length,
    clear_errors,
    heartbeat,
    heartbeats_under,
    number_of,
    quietly,
    received,
)

__all__ = [
    "Asked",
    "Bound",
    "Mode",
    "Number",
    "Publisher",
    "Received",
    "Session",
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
        """Zenoh's own object; for the door and nobody else."""

    def publisher(self, key: str) -> Publisher:
        """Declare a publisher on ``key``."""
        return Publisher(self.raw, key)

    def subscribe(
        self, key_expr: str, handler: Callable[[Received], None], at_most: Bound | None = None
    ) -> Subscription:
        """Call ``handler`` for every message under ``key_expr``, from a thread of Zenoh's.

        The handler must only hand over: while it works nothing else is received, and after five
        seconds of that Zenoh gives up links and loses messages without a word. The subscription is
        a plain one, because an advanced one drops what bears an earlier timestamp than a message
        before it. What is larger than ``at_most`` is not copied out of Zenoh.
        """

        def receive(sample: zenoh.Sample) -> None:
            if at_most is not None and len(sample.payload) > at_most.size_bytes:
                at_most.refuse(str(sample.key_expr), number_of(sample))
            else:
                handler(received(sample))

        check_key_length(key_expr)
        with clear_errors(f"key expression {key_expr!r} cannot be subscribed to"):
            return Subscription(self.raw.declare_subscriber(key_expr, receive))

    def heartbeats(self, key_expr: str, handler: Callable[[Number], None]) -> Subscription:
        """Call ``handler`` with the last number of every advanced publisher under ``key_expr``, as
        often as it tells; like `subscribe` from a thread of Zenoh's."""

        def receive(sample: zenoh.Sample) -> None:
            number = heartbeat(sample)
            if number is not None:
                handler(number)

        expression = heartbeats_under(key_expr)
        check_key_length(expression)
        with clear_errors(f"key expression {expression!r} cannot be subscribed to"):
            return Subscription(self.raw.declare_subscriber(expression, receive))

    def send(self, key: str, payload: bytes) -> None:
        """Send one message that may be dropped if the network is full; never blocks on it."""
        check_key_length(key)
        with clear_errors(f"key {key!r}: not sent"):
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

        with clear_errors(f"key {key!r} cannot be answered on"):
            return Subscription(self.raw.declare_queryable(key, hand_over, complete=True))

    def ask(
        self, selector: str, payload: bytes | None = None, *, timeout_s: float
    ) -> list[tuple[bool, bytes]]:
        """Like `get`, with the refusals: (True, answer) and (False, error) as they came."""
        check_key_length(selector)
        with clear_errors(f"selector {selector!r} cannot be asked"):
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
        with quietly():
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
    configure(config, zenoh.Config(), options, mode)
    connect, listen = config.get_json("connect/endpoints"), config.get_json("listen/endpoints")
    try:
        return Session(zenoh.open(config))
    except BaseException as error:
        if isinstance(error, zenoh.ZError) or is_panic(error):
            raise cannot_open(error, json.loads(connect), json.loads(listen)) from None
        raise


def _config_from_file(path: Path | None) -> zenoh.Config:
    if path is None:
        return zenoh.Config()
    if not path.is_file():
        raise MisuseError(f"{path}: no such Zenoh configuration file; check --zenoh-config")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise MisuseError(f"{path}: not a Zenoh configuration: {plain(error)}") from None


class Router:
    """A running router: ``with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router: …``.

    ``endpoints`` is where it listens; port 0 asks the system for a free port, and stands there
    with the number it got. Raises TransportError if it cannot listen.
    """

    def __init__(self, options: ZenohOptions) -> None:
        self._session = open_session(options, mode="router")
        self.endpoints = tuple(self._session.locators)

    def close(self) -> None:
        """Stop routing and free the port. May be called twice."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()
