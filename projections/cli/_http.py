"""Where `mapfold serve` listens for HTTP, and who may ask there.

An address that others can reach demands a token; everything is checked before a database is
opened.
"""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from eventsrc.cli._shell import say
from eventsrc.errors import MisuseError

if TYPE_CHECKING:  # what needs the extra [serve] is imported when it is asked for
    import socket
    import ssl

    from projections.serve import Answerer, Room


@dataclass(frozen=True, slots=True)
class HttpOptions:
    """The options beside ``--http``."""

    token_file: Path | None
    tls_cert: Path | None
    tls_key: Path | None
    hosts: tuple[str, ...]

    def refuse_without_http(self) -> None:
        """Raise MisuseError when one of them is given, as they mean nothing without ``--http``."""
        for name, value in (
            ("--token-file", self.token_file),
            ("--tls-cert", self.tls_cert),
            ("--tls-key", self.tls_key),
            ("--allow-host", self.hosts),
        ):
            if value:
                raise MisuseError(f"{name} is for HTTP; give --http HOST:PORT too")


@dataclass(frozen=True, slots=True)
class HttpDoor:
    """A bound address, and who may ask there."""

    host: str
    listener: "socket.socket"
    token: str | None
    tls: "ssl.SSLContext | None"
    hosts: tuple[str, ...]

    @classmethod
    @contextmanager
    def opened(cls, http: str, options: HttpOptions) -> Iterator[Self]:
        """Bind ``http``, which is HOST:PORT. Raises MisuseError when it must not be served so."""
        host, colon, port = http.rpartition(":")
        if not colon or not port.isdecimal() or int(port) > 65_535:
            raise MisuseError(f"--http {http}: write it as HOST:PORT, such as 127.0.0.1:8080")
        host = host.strip("[]") or "127.0.0.1"
        try:
            from projections.serve.guard import TOKEN_VARIABLE, read_token
            from projections.serve.listening import bind, is_loopback, tls_context
        except ModuleNotFoundError as error:
            raise MisuseError(
                f"--http needs {error.name}, which is not installed; pip install 'mapfold[serve]'"
            ) from None
        if (options.tls_cert is None) != (options.tls_key is None):
            raise MisuseError("--tls-cert and --tls-key need each other; give both")
        token, tls = read_token(options.token_file, os.environ, say), None
        if options.tls_cert is not None and options.tls_key is not None:
            tls = tls_context(options.tls_cert, options.tls_key)
        with closing(bind(host, int(port))) as listener:
            local = is_loopback(listener)
            if token is None and not local:
                raise MisuseError(
                    f"--http {http} can be reached by others, so it needs a token: openssl rand"
                    f" -hex 32 > FILE, then --token-file FILE or {TOKEN_VARIABLE}; or give --http"
                    f" 127.0.0.1:{port}"
                )
            if tls is None and not local:
                say(
                    f"warning: --http {http} without TLS: others on the way can read the token and"
                    " all answers; give --tls-cert and --tls-key"
                )
            yield cls(host, listener, token, tls, options.hosts)

    @contextmanager
    def serving(self, answerer: "Answerer", room: "Room") -> Iterator[str]:
        """Answer until the end of the block; yields the URL."""
        from projections.serve.guard import Guard
        from projections.serve.http import create_app
        from projections.serve.listening import serving

        guarded = Guard(create_app(answerer, room), self.token, (self.host, *self.hosts))
        with serving(guarded, self.listener, self.tls, say) as port:
            shown = f"[{self.host}]" if ":" in self.host else self.host
            yield f"{'http' if self.tls is None else 'https'}://{shown}:{port}"
