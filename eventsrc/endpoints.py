"""Where Zenoh connects and listens: ``<protocol>/<address>``, such as ``tcp/127.0.0.1:7447``.

Zenoh itself reports a malformed endpoint as "unable to connect", which sends people looking for a
router that runs very well. So endpoints are checked here, before a session is opened. No I/O.
"""

import ipaddress
from collections.abc import Iterable
from typing import Final

from .errors import MisuseError

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
