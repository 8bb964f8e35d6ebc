"""Publishers, subscriptions and queryables of a Zenoh session, and the messages it receives.

Other packages use them through `eventsrc.record.transport.session`, which states the rules.
"""

import contextlib
import re
import sys
import threading
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Final, NamedTuple

import msgspec
import zenoh

from eventsrc.base.errors import TransportError
from eventsrc.base.text import advised

from .config import DEFAULT_ENDPOINT

_SOURCE_PLACE: Final = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_PANIC: Final = ("pyo3_runtime", "PanicException")
_SYSTEM_ERROR: Final = re.compile(r"\[[^\]]*: (.+ \(os error \d+\))\]?")


def is_panic(error: BaseException) -> bool:
    """Whether ``error`` is a panic of Zenoh. pyo3 raises a BaseException without a public name."""
    kind = type(error)
    return (kind.__module__, kind.__name__) == _PANIC


def one_line(error: BaseException) -> str:
    """Zenoh's message on one line, without locations in its source."""
    text = " ".join(_SOURCE_PLACE.sub("", str(error)).split())
    inner = _SYSTEM_ERROR.search(text)
    return (inner.group(1) if inner else text).rstrip(" .!")


def open_error(error: BaseException, connect: object, listen: object) -> TransportError:
    """The error of a session that does not open; ``connect`` and ``listen`` are its endpoints."""
    message = str(error)
    if "listener" in message:
        return TransportError(
            f"cannot listen on {_joined(listen)}: {one_line(error)}; "
            "stop what listens there or choose another endpoint with --listen"
        )
    if "Unable to connect" in message:
        return TransportError(
            f"no Zenoh router or peer answers at {_joined(connect)}; "
            f"start one with `{_router_at(connect)}` or say where it is with --connect"
        )
    return TransportError(f"no Zenoh session: {one_line(error)}; check --zenoh-config")


def _router_at(endpoints: object) -> str:
    """The command line of a router that listens on the first endpoint of a session."""
    first = endpoints[0] if isinstance(endpoints, list) and endpoints else None
    listen = () if first in (None, DEFAULT_ENDPOINT) else ("--listen", first)
    return advised("router", *listen, without=("--connect", "--zenoh-config"))


def _joined(endpoints: object) -> str:
    return ", ".join(map(str, endpoints)) if isinstance(endpoints, list) else str(endpoints)


class transport_errors:  # noqa: N801 (used as a function is)
    """Context manager: convert exceptions of Zenoh to a TransportError that begins with ``place``.

    The message names a panic as such: the session may be unusable afterwards. Reusable; a generator
    function would take 1 µs more for each message sent.
    """

    def __init__(self, place: str) -> None:
        self._place = place

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if error is None:
            return
        if isinstance(error, zenoh.ZError):
            raise TransportError(f"{self._place}: {one_line(error)}") from None
        if is_panic(error):
            raise TransportError(f"{self._place}: Zenoh panicked: {one_line(error)}") from None


@contextlib.contextmanager
def ignore_transport_errors() -> Iterator[None]:
    """Ignore exceptions of Zenoh within a ``with`` block that closes something."""
    with contextlib.suppress(TransportError), transport_errors("closing"):
        yield


_MAX_KEY_BYTES: Final = 16 * 1024
"""Zenoh panics when a key does not fit into one batch of 64 KiB with the rest of its content."""
CHANNEL_SIZE: Final = 256
"""Messages received and in no batch yet: those of 12 ms at 20,000 a second."""
_MAX_BATCH_BYTES: Final = 4 * 1024 * 1024
"""Payload bytes that end a batch."""
_PAUSE_FROM: Final = 8
_PAUSE_S: Final = 0.002
"""Pause after a batch of at least `_PAUSE_FROM` messages; at 20,000 a second 40 come meanwhile."""
_JSON: Final = zenoh.Encoding.APPLICATION_JSON
_HEARTBEATS: Final = "@adv/pub/"
"""In a heartbeat's key: between the publisher's key and its session and entity id."""
_HEARTBEAT_BYTES: Final = 4


class SequenceNumber(NamedTuple):
    """The number that an advanced publisher gave to a message.

    ``source`` is the publisher's ``<session id>:<entity id>``, ``value`` has 32 bits and wraps.
    """

    source: str
    value: int


class Received(msgspec.Struct, frozen=True, gc=False):
    """One message, with its publisher's number if it has one.

    Zenoh's timestamp is not read: it may be missing, repeated or out of order.
    """

    key: str
    payload: bytes
    number: SequenceNumber | None = None


class SizeLimit(NamedTuple):
    """Messages over ``size_bytes`` are not received; ``refuse`` is called for each."""

    size_bytes: int
    refuse: Callable[[], None]


class Query:
    """A query to a queryable. Reply once, from any thread; that ends it.

    ``key`` is the key expression of the query, which may hold wildcards. ``size`` and
    ``selector_size`` are the bytes of the payload and of the key with its parameters, known
    without reading either.
    """

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self.key = str(query.key_expr)
        self.size = len(query.payload) if query.payload is not None else 0
        self.selector_size = len(str(query.selector))
        self.ended = False

    @property
    def parameters(self) -> dict[str, str]:
        """The parameters, after the ``?`` of the selector."""
        return _parameters(str(self._query.parameters))

    @property
    def payload(self) -> bytes:
        """A copy of the payload; empty if the query has none."""
        return self._query.payload.to_bytes() if self._query.payload is not None else b""

    def reply(self, key: str, payload: bytes) -> None:
        """Reply under ``key``. The payload is JSON, and Zenoh's encoding says so: other clients,
        such as the REST plugin of a router, show it by its encoding."""
        self._end(lambda: self._query.reply(key, payload, encoding=_JSON))

    @property
    def attachment(self) -> bytes:
        """A copy of the attachment; empty if the query has none."""
        return b"" if self._query.attachment is None else self._query.attachment.to_bytes()

    def reply_attached(self, key: str, payload: bytes, attachment: bytes) -> None:
        """Reply under ``key`` with bytes that are no JSON, and an attachment."""
        self._end(lambda: self._query.reply(key, payload, attachment=attachment))

    def reply_error(self, payload: bytes) -> None:
        """Reply with an error, which is JSON."""
        self._end(lambda: self._query.reply_err(payload, encoding=_JSON))

    def close(self) -> None:
        """End it without a reply."""
        self._end(lambda: None)

    def _end(self, send: Callable[[], None]) -> None:
        with ignore_transport_errors():  # the peer that asked may be gone
            send()
        self._query.drop()  # type: ignore[no-untyped-call]
        self.ended = True


class Publisher:
    """Sends bytes under one key: reliable, in order, blocking while the network is full."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        check_key_length(key)
        self.key = key
        self._not_sent = transport_errors(f"key {key!r}: not sent")
        self.departures = 0
        """How many times the last subscriber has left."""
        with transport_errors(f"key {key!r} cannot be published to"):
            self._sender: Any = session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
            )
            self._listener: Any = self._sender.declare_matching_listener(self._on_matching)

    def _on_matching(self, status: Any) -> None:
        self.departures += not status.matching

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Send. Returns when Zenoh has accepted the message; it may not have been received yet."""
        with self._not_sent:
            self._sender.put(payload, attachment=attachment)

    @property
    def has_subscriber(self) -> bool:
        """Whether this session knows of a subscriber to this key."""
        with transport_errors(f"key {self.key!r}: the session is gone"):
            status: Any = self._sender.matching_status  # not a bool, as its stubs say
            return bool(status.matching)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait for a subscriber to this key; False when there was none in time."""
        matched = threading.Event()
        with transport_errors(f"key {self.key!r}: the session is gone"):
            listener = self._sender.declare_matching_listener(
                lambda status: matched.set() if status.matching else None
            )
        try:
            return self.has_subscriber or matched.wait(timeout_s)
        finally:
            listener.undeclare()

    def close(self) -> None:
        """Stop publishing under this key."""
        with ignore_transport_errors():
            self._listener.undeclare()
            self._sender.undeclare()


class Subscription:
    """A declared subscription or queryable. Closing it, or its session, ends the calls."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Stop receiving."""
        with ignore_transport_errors():
            for entity in self._declared:
                entity.undeclare()


class BatchSubscription(Subscription):
    """A subscription with a thread that reads messages from Zenoh's channel in batches.

    Zenoh calls a handler with the interpreter lock taken, so each message would make the thread
    that records wait. The thread needs the lock once a batch. While many messages come it pauses
    between batches, so that there are fewer of them.
    """

    def __init__(
        self,
        subscriber: "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]",
        handler: Callable[[list[Received]], None],
    ) -> None:
        super().__init__(subscriber)
        self._thread = threading.Thread(
            target=_receive_batches,
            args=(subscriber.handler, handler),
            name="zenoh-batches",
            daemon=True,
        )
        self._thread.start()

    def close(self) -> None:
        """Stop receiving; returns when every message received so far is handled."""
        super().close()
        self._thread.join()


def _receive_batches(
    channel: "zenoh.handlers.Handler[zenoh.Sample]",
    handler: Callable[[list[Received]], None],
) -> None:
    """Call ``handler`` with the messages in a channel until the subscription has ended and the
    channel is empty. An exception is reported and ends one batch only, as Zenoh does with those of
    a callback."""
    pause = threading.Event()  # never set
    while True:
        try:
            count = _receive_batch(channel.recv(), channel, handler)
        except zenoh.ZError:  # empty and closed
            return
        if count >= _PAUSE_FROM:
            pause.wait(_PAUSE_S)


def _receive_batch(
    first: zenoh.Sample,
    channel: "zenoh.handlers.Handler[zenoh.Sample]",
    handler: Callable[[list[Received]], None],
) -> int:
    """Call ``handler`` with ``first`` and what is in ``channel``; returns how many messages that
    were, and keeps none of them in memory."""
    batch: list[Received] = []
    try:
        _fill_batch(first, channel, batch)
        handler(batch)
    except Exception:  # noqa: BLE001 - reported
        raised, thread = sys.exc_info(), threading.current_thread()
        threading.excepthook(threading.ExceptHookArgs((*raised, thread)))
    return len(batch)


def _fill_batch(
    first: zenoh.Sample,
    channel: "zenoh.handlers.Handler[zenoh.Sample]",
    batch: list[Received],
) -> None:
    """Append ``first`` and the messages in ``channel`` to ``batch``, up to its bounds."""
    sample: zenoh.Sample | None = first
    size = 0
    while sample is not None:
        data = sample.payload.to_bytes()
        batch.append(Received(str(sample.key_expr), data, sequence_number(sample)))
        size += len(data)
        if size >= _MAX_BATCH_BYTES or len(batch) >= CHANNEL_SIZE:
            return
        try:
            sample = channel.try_recv()
        except zenoh.ZError:  # empty and closed, which `recv` reports, too
            return


def _parameters(text: str) -> dict[str, str]:
    """Parse the parameters of a selector, ``name=value;name=value``."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


ReadAttachment = Callable[[bytes], tuple[str, int] | None]
"""Finds publisher and number in the attachment of a message; None if it has neither."""


def sequence_number(
    sample: zenoh.Sample, read_attachment: ReadAttachment | None = None
) -> SequenceNumber | None:
    """The number of ``sample``, by ``read_attachment`` if it is given; None if no advanced
    publisher sent it, or it has no such attachment."""
    if read_attachment is not None:
        attachment = sample.attachment
        found = None if attachment is None else read_attachment(attachment.to_bytes())
        return None if found is None else SequenceNumber(found[0], found[1] % 2**32)
    info = sample.source_info
    if info is None:
        return None
    return SequenceNumber(f"{info.source_id.zid}:{info.source_id.eid}", info.source_sn)


def heartbeats_under(key_expr: str) -> str:
    """The key expression of the heartbeats of all advanced publishers under ``key_expr``."""
    return f"{key_expr}/{_HEARTBEATS}**"


def parse_heartbeat(sample: zenoh.Sample) -> SequenceNumber | None:
    """The last number its publisher gave; None if ``sample`` is no heartbeat of a known form."""
    source = str(sample.key_expr).rpartition(_HEARTBEATS)[2].split("/")
    if len(source) < 2 or len(sample.payload) != _HEARTBEAT_BYTES:
        return None
    return SequenceNumber(":".join(source[:2]), int.from_bytes(sample.payload.to_bytes(), "little"))


def check_key_length(key: str) -> None:
    """Raise TransportError for a key so long that Zenoh would panic and end the session."""
    size = len(key.encode())
    if size > _MAX_KEY_BYTES:
        raise TransportError(
            f"key {key[:80]!r}…: {size:,} bytes are more than {_MAX_KEY_BYTES:,}; "
            "choose a shorter key"
        )
