"""``mapfold serve``: answer questions over Zenoh and HTTP until a signal; and ``mapfold mcp``: the
map for agents, over stdin and stdout or over HTTP.

HTTP on an address that others can reach requires a token. All options are checked before a database
is opened.
"""

import dataclasses
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Self

import typer

from eventsrc.base.errors import MisuseError, TransportError
from eventsrc.record.transport.session import Session, ZenohOptions, open_session
from projections.fold.map_errors import DatabaseUnavailable, ProjectionMissing
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from projections.surfaces.serve.answering import DEFAULT_MAX_BYTES
from projections.surfaces.serve.asked import ServedLog

from .folded_log import FoldSettings, NoCacheOption
from .options import (
    CameraOptions,
    Databases,
    LiveDbOption,
    LogOrDbArgument,
    VectorsOption,
    ZenohClient,
    ZenohPeer,
    option,
    user_at_host,
)
from .signals import stop_on_signals
from .terminal import say

if TYPE_CHECKING:  # modules that need the extra [serve] are imported when they are used
    import socket
    import ssl
    from collections.abc import Callable

    from starlette.types import ASGIApp

    from projections.surfaces.serve.service_metrics import ServiceMetrics


@dataclass(frozen=True, kw_only=True)
class HttpOptions:
    """The options beside ``--http``."""

    token_file: Annotated[
        Path | None,
        option(
            "FILE",
            "Token that HTTP requests must send [env MAPFOLD_TOKEN]; required unless"
            " --http is on loopback.",
            "--token-file",
        ),
    ] = None
    tls_cert: Annotated[
        Path | None, option("FILE", "PEM certificate: serve HTTPS.", "--tls-cert")
    ] = None
    tls_key: Annotated[Path | None, option("FILE", "PEM key of --tls-cert.", "--tls-key")] = None
    allow_host: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Name by which HTTP clients call this service, beside its addresses; may be repeated.",
            "--allow-host",
        ),
    ] = None
    cors: Annotated[
        list[str] | None,
        option(
            "ORIGIN",
            "Site whose pages may ask from a browser, such as https://map.example; may be"
            " repeated.",
            "--cors",
        ),
    ] = None

    def refuse_without_http(self) -> None:
        """Raise MisuseError when one of them is given."""
        for name, value in (
            ("--token-file", self.token_file),
            ("--tls-cert", self.tls_cert),
            ("--tls-key", self.tls_key),
            ("--allow-host", self.allow_host),
            ("--cors", self.cors),
        ):
            if value:
                raise MisuseError(f"{name} is for HTTP; give --http HOST:PORT too")


@dataclass(frozen=True, slots=True)
class HttpEndpoint:
    """A bound address and its access control."""

    host: str
    listener: "socket.socket"
    token: str | None
    tls: "ssl.SSLContext | None"
    hosts: tuple[str, ...]
    origins: tuple[str, ...]

    @classmethod
    @contextmanager
    def bound(cls, http: str, options: HttpOptions) -> Iterator[Self]:
        """Bind ``http``, a HOST:PORT. Raises MisuseError when the options do not allow it."""
        host, colon, port = http.rpartition(":")
        if not colon or not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65_535:
            raise MisuseError(f"--http {http}: write it as HOST:PORT, such as 127.0.0.1:8080")
        host = host.strip("[]") or "127.0.0.1"
        try:
            from projections.surfaces.serve.guard import TOKEN_VARIABLE, read_origin, read_token
            from projections.surfaces.serve.listening import bind, is_loopback, tls_context
        except ModuleNotFoundError as error:
            raise MisuseError(
                f"--http needs {error.name}, which is not installed; pip install 'mapfold[serve]'"
            ) from None
        if (options.tls_cert is None) != (options.tls_key is None):
            raise MisuseError("--tls-cert and --tls-key need each other; give both")
        origins = tuple(read_origin(origin) for origin in options.cors or ())
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
            yield cls(host, listener, token, tls, tuple(options.allow_host or ()), origins)

    @contextmanager
    def serving(
        self, answerer: Answerer, queue: FairQueue, metrics: "ServiceMetrics"
    ) -> Iterator[str]:
        """Serve until the end of the block; yields the URL."""
        from projections.surfaces.serve.http import create_app
        from projections.surfaces.serve.service_metrics import CountedResponses

        app = create_app(answerer, queue, metrics, secured=self.token is not None)
        with self.serving_app(app, lambda guarded: CountedResponses(guarded, metrics)) as url:
            yield url

    @contextmanager
    def serving_app(
        self, app: "ASGIApp", around: "Callable[[ASGIApp], ASGIApp]" = lambda guarded: guarded
    ) -> Iterator[str]:
        """Serve an application behind the access control until the end of the block; yields the
        URL."""
        from projections.surfaces.serve.guard import Guard, SafeHeaders
        from projections.surfaces.serve.listening import serving

        guarded = Guard(app, self.token, (self.host, *self.hosts), self.origins)
        with serving(around(SafeHeaders(guarded)), self.listener, self.tls, say) as port:
            shown = f"[{self.host}]" if ":" in self.host else self.host
            yield f"{'http' if self.tls is None else 'https'}://{shown}:{port}"


_LARGEST_BYTES: Final = 16 * 1024 * 1024
"""Zenoh drops longer questions without an answer; a shorter one over ``--max-bytes`` is refused."""


def serve(
    *,
    http: Annotated[
        str | None,
        option("HOST:PORT", "Answer over HTTP, too, at this address (extra [serve]).", "--http"),
    ] = None,
    options: HttpOptions,
    zenoh: Annotated[bool, typer.Option(help="Answer over Zenoh.")] = True,
    peer: ZenohPeer,
    workers: Annotated[
        int, option("N", "Questions answered at a time.", "--workers", min=1, max=64)
    ] = 4,
    rate: Annotated[
        float, option("N", "Questions a second on average; more are refused.", "--rate", min=0.1)
    ] = 500.0,
    max_bytes: Annotated[
        int, option("BYTES", "Longer questions are refused.", "--max-bytes", min=1000)
    ] = DEFAULT_MAX_BYTES,
    log: Annotated[
        Path | None,
        option(
            "LOG",
            "The log that the databases were made from, for HTTP's /changes, /crops and past maps.",
            "--log",
        ),
    ] = None,
    camera: CameraOptions,
    databases: Databases,
) -> None:
    """Answer questions from the live databases until Ctrl-C.

    Over Zenoh at mapfold/relocalize, mapfold/find and mapfold/state/**, over HTTP as described at
    its /docs. An invalid question gets an error as its answer. On SIGINT or SIGTERM open questions
    are answered first.
    """
    if http is None and not zenoh:
        raise MisuseError("nothing to serve on; give --http HOST:PORT, or leave out --no-zenoh")
    asked_by = camera.camera
    session_options = dataclasses.replace(
        peer.zenoh, max_message_bytes=max(_LARGEST_BYTES, 4 * max_bytes)
    )
    with ExitStack() as stack:
        endpoint = None if http is None else stack.enter_context(HttpEndpoint.bound(http, options))
        if http is None:
            options.refuse_without_http()
        stop = stack.enter_context(stop_on_signals())
        targets = stack.enter_context(databases.opened())
        pools = stack.enter_context(Pools(targets, workers, lambda what: say(f"mapfold: {what}")))
        beside = None
        if log is not None:
            beside = stack.enter_context(closing(ServedLog(log, say)))
            with suppress(ProjectionMissing, DatabaseUnavailable):  # each question says it
                beside.refuse_other(pools.view())
        answerer = Answerer(
            pools, per_second=rate, max_bytes=max_bytes, camera=asked_by, log=beside, note=say
        )
        session = None
        if zenoh:
            patient = endpoint is not None
            session = stack.enter_context(_open_session(session_options, patient=patient))
        # Closed before the session, which sends its last answers.
        queue = stack.enter_context(FairQueue(workers))
        metrics = None if endpoint is None else _metrics(answerer, queue)
        if session is not None:
            watch = (lambda *_: None) if metrics is None else metrics.watch
            stack.enter_context(ZenohService(session, answerer, queue, watch))
            say("answering mapfold/relocalize, mapfold/find and mapfold/state/** over Zenoh")
        if endpoint is not None and metrics is not None:
            url = stack.enter_context(endpoint.serving(answerer, queue, metrics))
            say(f"answering {url}, described at /docs")
        say("Ctrl-C ends it")
        stop.wait()
    say("service ended")


def _open_session(options: ZenohOptions, *, patient: bool) -> Session:
    """The session to answer over. If ``patient``, it is opened also where no router answers, and
    joins when one does: a line says so."""
    try:
        return open_session(options, mode=options.mode)
    except TransportError as error:
        if not patient:
            raise
        later = dataclasses.replace(options, joins_later=True)
        session = open_session(later, mode=later.mode)
        say(f"{error}; it is joined when it answers")
        return session


def _metrics(answerer: Answerer, queue: FairQueue) -> "ServiceMetrics":
    from projections.surfaces.serve.service_metrics import ServiceMetrics

    return ServiceMetrics(answerer, queue)


def mcp(
    *,
    log: LogOrDbArgument = None,
    db: LiveDbOption = None,
    vector_db: VectorsOption = None,
    http: Annotated[
        str | None,
        option("HOST:PORT", "Serve over HTTP at /mcp instead of stdin and stdout.", "--http"),
    ] = None,
    options: HttpOptions,
    allow_edits: Annotated[
        bool,
        typer.Option("--allow-edits", help="Let agents name places and undo commands, by reason."),
    ] = False,
    settings: FoldSettings,
    no_cache: NoCacheOption = False,
    client: ZenohClient,
) -> None:
    """Serve the map to agents by the Model Context Protocol (extra [mcp]).

    Tools find, room, changes, nearest, path, goal, why, where_am_i and state; each answer names the
    map and the events that it rests on. A growing log is followed. Over stdin until its end.
    """
    if (log is None) == (db is None):
        raise MisuseError("give a LOG, or --db URL to ask the databases")
    if log is None and allow_edits:
        raise MisuseError("--allow-edits records commands in a log; give LOG instead of --db")
    if log is not None and vector_db is not None:
        raise MisuseError("--vector-db is for --db, not for a log")
    if http is None:
        options.refuse_without_http()
    try:
        from projections.surfaces.mcp.agent_server import create_server, http_app
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold mcp needs {error.name}, which is not installed; pip install 'mapfold[mcp]'"
        ) from None
    from projections.surfaces.mcp.cited_maps import LiveMaps, LogMaps

    with ExitStack() as stack:
        endpoint = None if http is None else stack.enter_context(HttpEndpoint.bound(http, options))
        maps: LogMaps | LiveMaps
        if log is not None:
            maps = stack.enter_context(
                LogMaps(
                    log,
                    settings.checked(),
                    cache=not no_cache,
                    note=say,
                    issued_by=f"mcp of {user_at_host()}",
                    open_session=client.session if allow_edits else None,
                )
            )
        else:
            settings.of_past_map(None)  # refuses settings
            # Imported here: the drivers take as long to import as a small map to fold.
            from projections.postgres.connection import open_targets

            targets = stack.enter_context(open_targets(db or None, vector_db))
            maps = LiveMaps(stack.enter_context(Pools(targets, 2, say)))
        server = create_server(maps, allow_edits=allow_edits)
        if endpoint is None:
            say("answering over stdin and stdout until the end of stdin")
            server.run("stdio")
            return
        stop = stack.enter_context(stop_on_signals())
        url = stack.enter_context(endpoint.serving_app(http_app(server)))
        say(f"answering {url}/mcp; Ctrl-C ends it")
        stop.wait()
    say("service ended")
