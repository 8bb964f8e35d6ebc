"""Zenoh options and their checks: endpoints, session configuration, keys. Does not import zenoh.

* `check_endpoint`: an endpoint is ``<protocol>/<address>``, such as ``tcp/127.0.0.1:7447``. Zenoh
  reports a malformed one as "unable to connect", so endpoints are checked before a session opens.
* `configure`: the rules at the head of `eventsrc.record.transport.session`, applied to a
  configuration.
  Endpoints of the command line take precedence over those of a configuration file.
* `check_key`: keys that envelopes can be published under.
"""

import ipaddress
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.system_events import RESERVED_PREFIX, is_system_key

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where `mapfold router` listens and every other command connects by default."""

_WITH_PORT: Final = ("tcp", "udp", "tls", "quic", "ws")
_WITHOUT_PORT: Final = ("unixsock-stream", "unixpipe", "serial", "vsock")
_EXAMPLE: Final = f"write it as <protocol>/<host>:<port>, for example {DEFAULT_ENDPOINT}"


def check_endpoint(text: str) -> str:
    """Return ``text`` if it is an endpoint; raise MisuseError that says what is wrong otherwise."""
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
    """Host and port of ``HOST:PORT``, or of ``PORT`` on loopback. MisuseError names ``option``."""
    host, colon, port = text.rpartition(":")
    if not _is_port(port) or (colon and not host):
        raise MisuseError(f"{option} {text!r} is neither PORT nor HOST:PORT; try {option} 9464")
    return host or "127.0.0.1", int(port)


def is_loopback(host: str) -> bool:
    """Whether ``host`` is a loopback address or ``localhost``."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"


def _is_port(text: str) -> bool:
    return re.fullmatch("[0-9]{1,5}", text) is not None and int(text) <= 65_535


def _check_host_and_port(text: str, address: str) -> None:
    host, colon, port = address.rpartition(":")
    if not colon or not host:
        raise MisuseError(f"endpoint {text!r} has no port; {_EXAMPLE}")
    if not _is_port(port):
        raise MisuseError(f"endpoint {text!r}: {port!r} is no port (0 to 65535); {_EXAMPLE}")


Mode = Literal["client", "peer", "router"]

_OPEN_TIMEOUT_MS: Final = 5_000
_LISTEN: Final = "listen/endpoints"
_MAX_MESSAGE: Final = "transport/link/rx/max_message_size"
_RECEIVED: Final = "transport/link/rx/buffer_size"
_RECEIVED_BYTES: Final = 4 * 1024 * 1024
"""Size of the receive buffers that Zenoh reuses. Its default is one of 64 KiB; while messages in it
are unread, Zenoh allocates and zeroes another for every few messages of 9 kB, which takes 2 µs a
message. Pages that are never written take no memory."""


@dataclass(frozen=True, slots=True)
class ZenohOptions:
    """Where to connect, where to listen, and a Zenoh configuration file (JSON5) for the rest.

    ``connect`` and ``listen`` take precedence over the file. TLS, access control and scouting are
    set in the file only. Zenoh drops messages of more than ``max_message_bytes``, unless the file
    sets that bound; Zenoh's default is 1 GiB for each of several messages in transit. With
    ``joins_later`` a peer is opened although nothing answers, and connects when something does.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config_file: Path | None = None
    max_message_bytes: int | None = None
    joins_later: bool = False

    @property
    def mode(self) -> Literal["client", "peer"]:
        """The mode of a recorder or publisher with these options: a peer if it listens, or joins
        later."""
        return "peer" if self.listen or self.joins_later else "client"


class Config(Protocol):
    """The methods of zenoh.Config that are used here; keys are paths, values JSON5."""

    def get_json(self, key: str) -> Any: ...
    def insert_json5(self, key: str, value: Any) -> None: ...


def configure(config: Config, defaults: Config, options: ZenohOptions, mode: Mode) -> None:
    """Apply ``options`` and the rules to ``config``.

    ``config`` comes from a file or equals ``defaults``, Zenoh's own. Raises MisuseError for a
    malformed endpoint.
    """
    connect, listen = check_endpoints(options.connect), check_endpoints(options.listen)
    connects = mode == "client" or options.joins_later
    if not connect and connects and _is_unset(config, "connect/endpoints"):
        connect = (DEFAULT_ENDPOINT,)
    _set(config, "mode", mode)
    _set(config, "transport/shared_memory/enabled", False)
    if connect:
        _set(config, "connect/endpoints", connect)
    if listen or not _file_sets_listen(config, defaults, mode):
        # By default Zenoh's routers listen on every address of the machine.
        loopback_or_none = (DEFAULT_ENDPOINT,) if mode == "router" else ()
        _set(config, _LISTEN, listen or loopback_or_none)
    max_bytes = options.max_message_bytes
    if max_bytes and config.get_json(_MAX_MESSAGE) == defaults.get_json(_MAX_MESSAGE):
        _set(config, _MAX_MESSAGE, max_bytes)
    if mode == "client" and config.get_json(_RECEIVED) == defaults.get_json(_RECEIVED):
        _set(config, _RECEIVED, _RECEIVED_BYTES)  # not for many links
    _configure_scouting(config)
    if mode == "peer":  # not for a router: it may start before the routers it connects to
        _set(config, "connect/exit_on_failure", not options.joins_later)
        _set(config, "connect/timeout_ms", _OPEN_TIMEOUT_MS)
    if mode == "router":
        _set(config, "adminspace/enabled", True)  # `Session.locators` queries it


def _configure_scouting(config: Config) -> None:
    """Turn scouting off, and its delay of half a second with it, unless the file turns it on."""
    if _is_unset(config, "scouting/multicast/enabled"):
        _set(config, "scouting/multicast/enabled", False)
    scouts = json.loads(config.get_json("scouting/multicast/enabled"))
    if not scouts and _is_unset(config, "scouting/delay"):
        _set(config, "scouting/delay", 0)


def _file_sets_listen(config: Config, defaults: Config, mode: Mode) -> bool:
    """Whether the file sets listen endpoints for ``mode``.

    Endpoints equal to Zenoh's defaults, as in a copy of its example file, count as not set.
    """
    if config.get_json(_LISTEN) == defaults.get_json(_LISTEN):
        return False
    endpoints = json.loads(config.get_json(_LISTEN))
    return not isinstance(endpoints, dict) or mode in endpoints


def _set(config: Config, key: str, value: object) -> None:
    config.insert_json5(key, json.dumps(value))


def _is_unset(config: Config, key: str) -> bool:
    return json.loads(config.get_json(key)) in (None, [])


MAX_KEY_BYTES: Final = 1024
"""Bound of a key in UTF-8. A log repeats the key in each chunk, and the key of a refusal is built
from it; Zenoh itself panics on keys of 64 kB."""
_FORBIDDEN = frozenset("*$?#")


def check_key(key: str, option: str) -> str:
    """``key``, if envelopes can be published under it; else MisuseError that names ``option``."""
    if is_system_key(key):
        raise MisuseError(
            f"{option} {key!r}: keys under {RESERVED_PREFIX} are mapfold's own; choose another"
        )
    fault = _publish_fault(key)
    if fault:
        raise MisuseError(
            f"{option} {key!r}: {fault}, so nothing can be published under it; "
            "write a key such as tb/detections"
        )
    return key


def key_fault(key: str) -> str | None:
    """Why a log does not keep envelopes under ``key``; None if it does."""
    if is_system_key(key):
        return "is reserved for mapfold's own events"
    if key.isascii() and len(key) <= MAX_KEY_BYTES:  # the usual case
        return None
    try:
        size = len(key.encode())
    except UnicodeEncodeError:
        return "is no UTF-8"
    return f"is {size} bytes long, more than {MAX_KEY_BYTES}" if size > MAX_KEY_BYTES else None


def _publish_fault(key: str) -> str | None:
    if any(character in _FORBIDDEN for character in key):
        return "it has one of the characters * $ ? #"
    if any(character.isspace() or not character.isprintable() for character in key):
        return "it has white space or control characters"
    if not all(key.split("/")):
        return "a part of it is empty"
    fault = key_fault(key)
    return None if fault is None else f"it {fault}"
