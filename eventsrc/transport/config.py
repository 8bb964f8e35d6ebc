"""What every Zenoh session of ours is configured to do. It does not import zenoh.

The rules are those at the head of `eventsrc.transport.session`. A configuration file says the rest;
the command line's endpoints go before the file's.

Where Zenoh connects and listens: ``<protocol>/<address>``, such as ``tcp/127.0.0.1:7447``.

Zenoh itself reports a malformed endpoint as "unable to connect", which sends people looking for a
router that runs very well. So endpoints are checked here, before a session is opened. No I/O.

What Zenoh says when something fails, in words that help. Text only: it does not import zenoh.

Keys that envelopes can be published under: Zenoh's, without what only a subscriber may write,
and not too long.
"""

import ipaddress
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from eventsrc.errors import MisuseError, TransportError
from eventsrc.system_events import RESERVED_PREFIX, is_system_key

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where `mapfold router` listens and every other command connects unless told otherwise."""

_WITH_PORT: Final = ("tcp", "udp", "tls", "quic", "ws")
_WITHOUT_PORT: Final = ("unixsock-stream", "unixpipe", "serial", "vsock")
_EXAMPLE: Final = f"write it as <protocol>/<host>:<port>, for example {DEFAULT_ENDPOINT}"


def check_endpoint(text: str) -> str:
    """Return ``text`` if it is an endpoint; raise MisuseError that says what is wrong if not."""
    protocol, slash, rest = text.partition("/")
    if not slash:
        raise MisuseError(f"endpoint {text!r} has no protocol; {_EXAMPLE}")
    if protocol not in _WITH_PORT + _WITHOUT_PORT:
        raise MisuseError(f"endpoint {text!r}: {protocol!r} is no Zenoh protocol; {_EXAMPLE}")
    address = rest.partition("#")[0].partition("?")[0]
    if not address:
        raise MisuseError(f"endpoint {text!r} has no address; {_EXAMPLE}")
    if protocol in _WITH_PORT:
        _check_host_and_port(text, address)
    return text


def check_endpoints(texts: Iterable[str]) -> tuple[str, ...]:
    """`check_endpoint` for each, in order."""
    return tuple(check_endpoint(text) for text in texts)


def parse_address(text: str, option: str) -> tuple[str, int]:
    """``PORT``, which means this machine only, or ``HOST:PORT``; MisuseError names ``option``."""
    host, colon, port = text.rpartition(":")
    if not _is_port(port) or (colon and not host):
        raise MisuseError(f"{option} {text!r} is neither PORT nor HOST:PORT; try {option} 9464")
    return host or "127.0.0.1", int(port)


def is_loopback(host: str) -> bool:
    """Whether only this machine can connect to what listens on ``host``, as far as one can tell."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and int(text) <= 65_535


def _check_host_and_port(text: str, address: str) -> None:
    host, colon, port = address.rpartition(":")
    if not colon or not host:
        raise MisuseError(f"endpoint {text!r} has no port; {_EXAMPLE}")
    if not _is_port(port):
        raise MisuseError(f"endpoint {text!r}: {port!r} is no port (0 to 65535); {_EXAMPLE}")


Mode = Literal["client", "peer", "router"]

_OPEN_TIMEOUT_MS: Final = 5_000
_LISTEN: Final = "listen/endpoints"
_LARGEST_MESSAGE: Final = "transport/link/rx/max_message_size"


@dataclass(frozen=True, slots=True)
class ZenohOptions:
    """Where to connect, where to listen, and a Zenoh configuration file (JSON5) for the rest.

    ``connect`` and ``listen`` go before what the file says. TLS, access control and scouting are
    the file's business. ``largest_message_bytes`` is for a session that receives from strangers:
    Zenoh drops a message that is larger, unless the file says how large one may be; its own bound
    is 1 GiB, of each of several that may be under way.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config_file: Path | None = None
    largest_message_bytes: int | None = None

    @property
    def mode(self) -> Literal["client", "peer"]:
        """What a recorder or a publisher is with these options: a peer if others may call it."""
        return "peer" if self.listen else "client"


class Config(Protocol):
    """The two methods of zenoh.Config that are needed; keys are paths, values JSON5."""

    def get_json(self, key: str) -> Any: ...
    def insert_json5(self, key: str, value: Any) -> None: ...


def configure(config: Config, zenoh: Config, options: ZenohOptions, mode: Mode) -> None:
    """Apply ``options`` and the rules to ``config``, which is the file's or else like ``zenoh``,
    what Zenoh itself says where nobody does. Raises MisuseError for a bad endpoint."""
    connect, listen = check_endpoints(options.connect), check_endpoints(options.listen)
    if not connect and mode == "client" and _is_unset(config, "connect/endpoints"):
        connect = (DEFAULT_ENDPOINT,)
    _set(config, "mode", mode)
    _set(config, "transport/shared_memory/enabled", False)
    if connect:
        _set(config, "connect/endpoints", connect)
    if listen or not _says_where_to_listen(config, zenoh, mode):
        # Zenoh's own routers would listen on every address of the machine, to anybody.
        nowhere_else = (DEFAULT_ENDPOINT,) if mode == "router" else ()
        _set(config, _LISTEN, listen or nowhere_else)
    largest = options.largest_message_bytes
    if largest and config.get_json(_LARGEST_MESSAGE) == zenoh.get_json(_LARGEST_MESSAGE):
        _set(config, _LARGEST_MESSAGE, largest)
    _configure_scouting(config)
    if mode == "peer":  # a router starts before the routers it is linked to; a peer's error counts
        _set(config, "connect/exit_on_failure", True)
        _set(config, "connect/timeout_ms", _OPEN_TIMEOUT_MS)
    if mode == "router":
        _set(config, "adminspace/enabled", True)  # where a router's real locators come from


def _configure_scouting(config: Config) -> None:
    """Off unless the file turns it on; and then no half second's wait for answers nobody gives."""
    if _is_unset(config, "scouting/multicast/enabled"):
        _set(config, "scouting/multicast/enabled", False)
    scouts = json.loads(config.get_json("scouting/multicast/enabled"))
    if not scouts and _is_unset(config, "scouting/delay"):
        _set(config, "scouting/delay", 0)


def _says_where_to_listen(config: Config, zenoh: Config, mode: Mode) -> bool:
    """Whether the file does, for this mode. One that says what Zenoh says anyway, as a copy of its
    example does, counts as one that says nothing."""
    if config.get_json(_LISTEN) == zenoh.get_json(_LISTEN):
        return False
    endpoints = json.loads(config.get_json(_LISTEN))
    return not isinstance(endpoints, dict) or mode in endpoints


def _set(config: Config, key: str, value: object) -> None:
    config.insert_json5(key, json.dumps(value))


def _is_unset(config: Config, key: str) -> bool:
    return json.loads(config.get_json(key)) in (None, [])


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


MAX_KEY_BYTES: Final = 1024
"""Bound of a key in UTF-8. A log repeats it in each of its chunks, and an answer's key is made of
it; Zenoh itself fails inside on keys of 64 kB."""
_ONLY_IN_EXPRESSIONS = frozenset("*$?#")


def check_key(key: str, option: str) -> str:
    """Return ``key`` if messages can bear it; MisuseError that names ``option`` if not."""
    if is_system_key(key):
        raise MisuseError(
            f"{option} {key!r}: keys under {RESERVED_PREFIX} are mapfold's own; choose another"
        )
    fault = _fault(key)
    if fault:
        raise MisuseError(
            f"{option} {key!r}: {fault}, so nothing can be published under it; "
            "write a key such as tb/detections"
        )
    return key


def fault_in_log(key: str) -> str | None:
    """Why a log does not keep envelopes under ``key``, whoever sends them; None if it does."""
    if is_system_key(key):
        return "is reserved for mapfold's own events"
    if key.isascii() and len(key) <= MAX_KEY_BYTES:  # as a rule, and quickly told
        return None
    try:
        size = len(key.encode())
    except UnicodeEncodeError:
        return "is no UTF-8"
    return f"is {size} bytes long, more than {MAX_KEY_BYTES}" if size > MAX_KEY_BYTES else None


def _fault(key: str) -> str | None:
    if any(character in _ONLY_IN_EXPRESSIONS for character in key):
        return "it is a pattern for many keys"
    if any(character.isspace() or not character.isprintable() for character in key):
        return "it holds white space"
    if not all(key.split("/")):
        return "a part of it is empty"
    in_log = fault_in_log(key)
    return None if in_log is None else f"it {in_log}"
