"""What Zenoh says when something fails, in words that help. Text only: it does not import zenoh."""

import re
from typing import Final

from .errors import TransportError

_SOURCE_PLACE: Final = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_PANIC: Final = ("pyo3_runtime", "PanicException")
_SYSTEM_ERROR: Final = re.compile(r"\[[^\]]*: (.+ \(os error \d+\))\]?")


def is_panic(error: BaseException) -> bool:
    """Whether Zenoh failed inside. What pyo3 raises then is no Exception and has no public name."""
    kind = type(error)
    return (kind.__module__, kind.__name__) == _PANIC


def plain(error: BaseException) -> str:
    """Zenoh's message on one line, without the places in its own source."""
    text = " ".join(_SOURCE_PLACE.sub("", str(error)).split())
    inner = _SYSTEM_ERROR.search(text)
    return (inner.group(1) if inner else text).rstrip(" .!")


def cannot_open(error: BaseException, connect: object, listen: object) -> TransportError:
    """Why a session does not open; ``connect`` and ``listen`` are its configured endpoints."""
    message = str(error)
    if "listener" in message:
        return TransportError(
            f"cannot listen on {_joined(listen)}: {plain(error)}; "
            "stop what listens there or choose another place with --listen"
        )
    if "Unable to connect" in message:
        return TransportError(
            f"no Zenoh router or peer answers at {_joined(connect)}; "
            "start one with `mapfold router` or say where it is with --connect"
        )
    return TransportError(f"no Zenoh session: {plain(error)}; check --zenoh-config")


def _joined(endpoints: object) -> str:
    return ", ".join(map(str, endpoints)) if isinstance(endpoints, list) else str(endpoints)
