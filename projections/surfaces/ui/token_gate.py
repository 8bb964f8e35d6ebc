"""Access control of the page: the token of the printed link, and refusal of cross-site requests.

* With ``everything`` every path needs the token: as ``Authorization: Bearer``, as ``?token=`` of
  the printed link, or as the cookie that this link sets. Browsers load scripts without headers.
* ``/api/edit``, which changes the log, needs it as ``Authorization: Bearer`` always: other sites
  and other services of this machine cannot make a browser send that.
* Questions that a page of another site, or of another port, makes a browser ask are refused by
  ``Sec-Fetch-Site``. ``Host`` and ``Origin`` are checked by `projections.surfaces.serve.guard`.
"""

import hmac
from http.cookies import CookieError, SimpleCookie
from typing import Final

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

EDIT_PATH: Final = "/api/edit"
_API: Final = "/api/"
_FOREIGN: Final = frozenset({"cross-site", "same-site"})


class TokenGate:
    """ASGI middleware. Without a ``token`` only `EDIT_PATH` is refused."""

    def __init__(self, app: ASGIApp, token: str | None, *, everything: bool) -> None:
        self._app = app
        self._token = token
        self._everything = everything

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        refused = self._refusal(scope)
        if refused is not None:
            await refused(scope, receive, send)
        elif self._everything and self._is_ours(_of_query(scope)):
            await self._app(scope, receive, self._with_cookie(scope, send))
        else:
            await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers, path = Headers(scope=scope), scope["path"]
        if path.startswith(_API) and headers.get("sec-fetch-site") in _FOREIGN:
            return _refuse(403, "a page of another site asks; open the printed link instead")
        bearer = _of_header(headers)
        if path.rstrip("/") == EDIT_PATH:
            if self._token is None:
                return _refuse(403, "the log is not to be changed; start with --allow-edits")
            if not self._is_ours(bearer):
                return _refuse(401, "send the token of the printed link: Authorization: Bearer …")
        elif self._everything:
            given = (bearer, _of_query(scope), _of_cookie(headers, _cookie_name(scope)))
            if not any(map(self._is_ours, given)):
                return _refuse(401, "this address needs a token; open the link that was printed")
        return None

    def _is_ours(self, given: str | None) -> bool:
        return (
            given is not None
            and self._token is not None
            and hmac.compare_digest(given.encode(), self._token.encode())
        )

    def _with_cookie(self, scope: Scope, send: Send) -> Send:
        """``send``, with the cookie in the answer."""

        async def with_cookie(message: Message) -> None:
            if message["type"] == "http.response.start":
                value = f"{_cookie_name(scope)}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                MutableHeaders(scope=message).append("Set-Cookie", value)
            await send(message)

        return with_cookie


def _cookie_name(scope: Scope) -> str:
    """The name of the cookie; it has the port, because browsers send a host's cookies to all of its
    ports."""
    return f"mapfold_{scope['server'][1]}"


def _of_header(headers: Headers) -> str | None:
    scheme, _, given = headers.get("authorization", "").partition(" ")
    return given.strip() if scheme.lower() == "bearer" else None


def _of_query(scope: Scope) -> str | None:
    query: bytes = scope.get("query_string", b"")
    return QueryParams(query).get("token")


def _of_cookie(headers: Headers, name: str) -> str | None:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return None
    return None if found is None else found.value


def _refuse(status: int, message: str) -> JSONResponse:
    headers = {"WWW-Authenticate": 'Bearer realm="mapfold"'} if status == 401 else None
    return JSONResponse({"error": {"kind": "refused", "message": message}}, status, headers)
