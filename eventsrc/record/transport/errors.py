"""Convert exceptions of Zenoh to TransportError with a message of one line."""

import contextlib
import re
from collections.abc import Iterator
from types import TracebackType
from typing import Final

import zenoh

from eventsrc.base.advised import advised
from eventsrc.base.errors import TransportError

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
