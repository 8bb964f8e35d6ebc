"""`mapfold serve`: answer lost robots over Zenoh and HTTP until a signal ends it."""

import dataclasses
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc._zenoh import open_session
from eventsrc.cli._shell import say
from eventsrc.cli._signals import stop_on_signals
from eventsrc.cli._zenoh_options import ConfigOption, ConnectOption, ListenOption, zenoh_options
from eventsrc.errors import MisuseError
from projections.cli._http import HttpDoor, HttpOptions
from projections.cli._options import DbOption, VectorDbOption
from projections.cli._question import HfovOption, ImageOption, camera_from
from projections.postgres.connect import open_targets
from projections.serve import Answerer, Pools, Room, ZenohService
from projections.serve.answering import DEFAULT_MAX_BYTES

_LARGEST_BYTES: Final = 16 * 1024 * 1024
"""What Zenoh puts together of one question. A longer one gets no answer; a shorter one that is over
``--max-bytes`` is told so."""


def serve(
    http: Annotated[
        str | None,
        typer.Option("--http", metavar="HOST:PORT", help="Serve HTTP there too (extra [serve])."),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            "--token-file",
            metavar="FILE",
            help="Token that HTTP requests must send [env MAPFOLD_TOKEN]; must be there unless"
            " --http is on loopback.",
        ),
    ] = None,
    tls_cert: Annotated[
        Path | None,
        typer.Option("--tls-cert", metavar="FILE", help="PEM certificate: serve HTTPS."),
    ] = None,
    tls_key: Annotated[
        Path | None, typer.Option("--tls-key", metavar="FILE", help="PEM key of --tls-cert.")
    ] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(
            "--allow-host",
            metavar="NAME",
            help="Name by which HTTP clients call this service, beside its addresses; may be"
            " repeated.",
        ),
    ] = None,
    zenoh: Annotated[bool, typer.Option(help="Serve mapfold/relocalize over Zenoh.")] = True,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    zenoh_config: ConfigOption = None,
    workers: Annotated[
        int, typer.Option("--workers", min=1, max=64, help="Questions answered at a time.")
    ] = 4,
    rate: Annotated[
        float, typer.Option("--rate", min=0.1, help="Questions a second, in the long run.")
    ] = 500.0,
    max_bytes: Annotated[
        int, typer.Option("--max-bytes", min=1000, help="Longer questions are refused.")
    ] = DEFAULT_MAX_BYTES,
    hfov: HfovOption = 69.4,
    image: ImageOption = "640x400",
    db: DbOption = None,
    vector_db: VectorDbOption = None,
) -> None:
    """Answer questions from the live databases until Ctrl-C.

    Over Zenoh at mapfold/relocalize and mapfold/state/**, over HTTP as /docs there tells. Errors
    come back as replies. On SIGINT or SIGTERM open questions are answered first.
    """
    if http is None and not zenoh:
        raise MisuseError("neither --zenoh nor --http: there is nothing to serve on")
    camera = camera_from(hfov, image)
    options = dataclasses.replace(
        zenoh_options(connect, listen, zenoh_config),
        largest_message_bytes=max(_LARGEST_BYTES, 4 * max_bytes),
    )
    given = HttpOptions(token_file, tls_cert, tls_key, tuple(allow_host or ()))
    with ExitStack() as stack:
        door = None if http is None else stack.enter_context(HttpDoor.opened(http, given))
        if http is None:
            given.refuse_without_http()
        stop = stack.enter_context(stop_on_signals())
        targets = stack.enter_context(open_targets(db, vector_db))
        pools = stack.enter_context(Pools(targets, workers, lambda what: say(f"mapfold: {what}")))
        answerer = Answerer(pools, per_second=rate, max_bytes=max_bytes, camera=camera, tell=say)
        session = None
        if zenoh:
            session = stack.enter_context(open_session(options, mode=options.mode))
        room = stack.enter_context(Room(workers))  # its last answers go over the session
        if session is not None:
            stack.enter_context(ZenohService(session, answerer, room))
            say("answering mapfold/relocalize and mapfold/state/** over Zenoh")
        if door is not None:
            url = stack.enter_context(door.serving(answerer, room))
            say(f"answering {url}, described at /docs")
        say("Ctrl-C ends it")
        stop.wait()
    say("service ended")


def register(app: typer.Typer) -> None:
    """Add `serve` to the program."""
    app.command()(serve)
