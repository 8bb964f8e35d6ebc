"""HTTP access control: ``Host``, ``Origin`` and a token, checked before anything else.

* ``Host`` must be an address of this machine, localhost or a name of ``--allow-host``. Otherwise a
  web page could point its own name at this address and read the answers (DNS rebinding).
* ``Origin``, which browsers send with requests of other sites, must equal ``Host`` or be one of
  ``--cors``. Pages of those may read the answers: they get the headers of CORS, and their preflight
  requests, which browsers send without a token, are answered. With ``--cors`` every response has
  ``Vary: Origin``, so that a cache does not give a page a response without those headers.
* With a token, every path requires it: ``Authorization: Bearer TOKEN``.
"""

import hmac
import os
import re
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, open_file

TOKEN_VARIABLE: Final = "MAPFOLD_TOKEN"  # noqa: S105  the name of a variable
MIN_TOKEN: Final = 16
_MAX_FILE: Final = 4096
_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_PORTS: Final = {"http": 80, "https": 443}
_HOST: Final = re.compile(r"[a-z0-9._-]+|[0-9a-f:]+")
_SAFE: Final = {
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}
_ADVICE: Final = "make one with: openssl rand -hex 32"


def read_token(
    file: Path | None, environment: Mapping[str, str], note: Callable[[str], None]
) -> str | None:
    """The token of ``file``, else of the environment, else None.

    Raises MisuseError for one that is empty, short or malformed. ``note`` gets a line when other
    users may read the file.
    """
    if file is None:
        given = environment.get(TOKEN_VARIABLE)
        return None if given is None else _checked(given, f"{TOKEN_VARIABLE} of the environment")
    try:
        with open_file(file) as opened:
            mode, raw = os.fstat(opened.fileno()).st_mode, opened.read(_MAX_FILE + 1)
    except (FileFault, OSError) as error:
        raise MisuseError(f"--token-file {file}: {error}") from None
    if mode & (stat.S_IRGRP | stat.S_IROTH):
        note(f"--token-file {file}: other users may read it; run chmod 600 {file}")
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


def read_origin(text: str) -> str:
    """An origin of ``--cors`` as browsers send it. Raises MisuseError."""
    wrong = MisuseError(
        f"--cors {text}: write an origin as a browser sends it, such as https://map.example or"
        " http://localhost:5173; each site is named, * is not taken"
    )
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        raise wrong from None
    host = parts.hostname
    if parts.scheme not in _PORTS or not host or not _HOST.fullmatch(host):
        raise wrong
    shown = f"[{host}]" if ":" in host else host
    named = f"{parts.scheme}://{shown}" + (f":{port}" if port is not None else "")
    if named != text.lower().removesuffix("/"):
        raise wrong
    return named.removesuffix(f":{_PORTS[parts.scheme]}")


class Guard:
    """ASGI middleware that passes on what is allowed and refuses the rest.

    ``origins`` are of `read_origin`.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str | None = None,
        hosts: Iterable[str] = (),
        origins: Iterable[str] = (),
    ) -> None:
        self._app = app
        self._token = None if token is None else token.encode()
        self._hosts = _LOOPBACK | {host.lower().strip("[]") for host in hosts}
        self._origins = frozenset(origins)
        self._shared = _Cors(
            self._with_token,
            allow_origins=[*self._origins],
            allow_methods=["GET", "HEAD", "POST"],
            allow_headers=["Authorization", "Content-Type"],
            expose_headers=["Retry-After", "WWW-Authenticate"],
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it; the start and end of the server are passed on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        await self._chosen(scope)(scope, receive, _varied(send) if self._origins else send)

    def _chosen(self, scope: Scope) -> ASGIApp:
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
        if origin is None or _site(origin) == authority.lower():
            return self._with_token
        if origin in self._origins and len(headers.getlist("origin")) == 1:
            return self._shared
        return _refuse(403, "the Origin header names another site")

    async def _with_token(self, scope: Scope, receive: Receive, send: Send) -> None:
        authorization = Headers(scope=scope).get("authorization", "")
        if self._token is None or self._has_token(authorization):
            await self._app(scope, receive, send)
            return
        refused = _refuse(
            401,
            "send the service's token: Authorization: Bearer TOKEN",
            {"WWW-Authenticate": 'Bearer realm="mapfold"'},
        )
        await refused(scope, receive, send)

    def _has_token(self, authorization: str) -> bool:
        scheme, _, given = authorization.partition(" ")
        ours = self._token or b""
        return hmac.compare_digest(given.strip().encode(), ours) and scheme.lower() == "bearer"


def _varied(send: Send) -> Send:
    """``send``, with ``Vary: Origin`` in a response that does not have it."""

    async def send_varied(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            if "origin" not in headers.get("vary", "").lower():
                headers.add_vary_header("Origin")
        await send(message)

    return send_varied


class _Cors(CORSMiddleware):
    """Starlette's, with refusals in the form of all others."""

    def preflight_response(self, request_headers: Headers) -> Response:
        """The answer to a browser that asks what a page of an allowed origin may send."""
        response = super().preflight_response(request_headers)
        if response.status_code < 400:
            return response
        return _refuse(
            403, "a page of another site may GET and POST, with Authorization and Content-Type"
        )


class SafeHeaders:
    """ASGI middleware that adds ``headers`` to every response, refusals too, that does not set
    them."""

    def __init__(self, app: ASGIApp, headers: Mapping[str, str] = _SAFE) -> None:
        self._app, self._headers = app, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)


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
