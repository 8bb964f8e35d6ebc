"""HTTP access control: ``Host``, ``Origin`` and a token, checked before anything else.

* ``Host`` must be an address of this machine, localhost or a name of ``--allow-host``. Otherwise a
  web page could point its own name at this address and read the answers (DNS rebinding).
* ``Origin``, which browsers send with requests of other sites, must equal ``Host``.
* With a token, every path requires it: ``Authorization: Bearer TOKEN``.
"""

import hmac
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from eventsrc.errors import MisuseError

TOKEN_VARIABLE: Final = "MAPFOLD_TOKEN"  # noqa: S105  the name of a variable
MIN_TOKEN: Final = 16
_MAX_FILE: Final = 4096
_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_ADVICE: Final = "make one with: openssl rand -hex 32"


def read_token(
    file: Path | None, environment: Mapping[str, str], warn: Callable[[str], None]
) -> str | None:
    """The token of ``file``, else of the environment, else None.

    Raises MisuseError for one that is empty, short or malformed. ``warn`` gets a line when other
    users may read the file.
    """
    if file is None:
        given = environment.get(TOKEN_VARIABLE)
        return None if given is None else _checked(given, f"{TOKEN_VARIABLE} of the environment")
    try:
        with file.open("rb") as opened:
            status, raw = os.fstat(opened.fileno()), opened.read(_MAX_FILE + 1)
    except OSError as error:
        raise MisuseError(f"--token-file {file}: {error.strerror or error}") from None
    if stat.S_ISREG(status.st_mode) and status.st_mode & (stat.S_IRGRP | stat.S_IROTH):
        warn(f"--token-file {file}: other users may read it; run chmod 600 {file}")
    return _checked(raw[:_MAX_FILE].decode("latin-1"), f"--token-file {file}")


def _checked(text: str, where: str) -> str:
    token = text.rstrip("\r\n")
    if len(token) < MIN_TOKEN:
        raise MisuseError(
            f"{where}: the token has {len(token)} characters, fewer than {MIN_TOKEN}; {_ADVICE}"
        )
    if not token.isascii() or not token.isprintable() or " " in token:
        raise MisuseError(
            f"{where}: a token is one line of printable ASCII without spaces; {_ADVICE}"
        )
    return token


class Guard:
    """ASGI middleware that passes on what is allowed and refuses the rest."""

    def __init__(self, app: ASGIApp, token: str | None = None, hosts: Iterable[str] = ()) -> None:
        self._app = app
        self._token = None if token is None else token.encode()
        self._hosts = _LOOPBACK | {host.lower().strip("[]") for host in hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        refused = self._refusal(scope)
        await (self._app if refused is None else refused)(scope, receive, send)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers = Headers(scope=scope)
        authority = headers.get("host", "")
        name = _name(authority)
        if name not in self._hosts and name != _own_address(scope):
            return _refuse(
                421,
                "the Host header does not name this service; ask by its address, or start it"
                " with --allow-host NAME",
            )
        origin = headers.get("origin")
        if origin is not None and _site(origin) != authority.lower():
            return _refuse(403, "the Origin header names another site")
        if self._token is not None and not self._has_token(headers.get("authorization", "")):
            return _refuse(
                401,
                "send the service's token: Authorization: Bearer TOKEN",
                {"WWW-Authenticate": 'Bearer realm="mapfold"'},
            )
        return None

    def _has_token(self, authorization: str) -> bool:
        scheme, _, given = authorization.partition(" ")
        ours = self._token or b""
        return hmac.compare_digest(given.strip().encode(), ours) and scheme.lower() == "bearer"


def _own_address(scope: Scope) -> str:
    """The address of this machine that the client connected to."""
    return str(scope["server"][0]).removeprefix("::ffff:")


def _name(authority: str) -> str | None:
    """The name or address in a Host header, without its port; None when it is malformed."""
    try:
        parts = urlsplit(f"//{authority}")
        _ = parts.port  # raises for what is no number
    except ValueError:
        return None
    plain = parts.netloc == authority and not parts.path and "@" not in authority
    return parts.hostname if plain else None


def _site(origin: str) -> str | None:
    """Host and port of an Origin header; None when it is malformed."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return None
    return parts.netloc.lower() if parts.scheme in ("http", "https") else None


def _refuse(status: int, message: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    return JSONResponse({"error": {"kind": "refused", "message": message}}, status, headers)
