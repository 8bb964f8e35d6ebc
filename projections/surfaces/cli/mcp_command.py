"""``mapfold mcp``: the map for agents, over stdin and stdout or over HTTP."""

from contextlib import ExitStack
from typing import Annotated

import typer

from eventsrc.base.errors import MisuseError

from .folded_log import FoldSettings, NoCacheOption
from .options import LiveDbOption, LogOrDbArgument, VectorsOption, ZenohClient, user_at_host
from .serve import HttpEndpoint, HttpOptions
from .signals import stop_on_signals
from .terminal import say


def mcp(
    *,
    log: LogOrDbArgument = None,
    db: LiveDbOption = None,
    vector_db: VectorsOption = None,
    http: Annotated[
        str | None,
        typer.Option(
            "--http",
            metavar="HOST:PORT",
            help="Serve over HTTP at /mcp instead of stdin and stdout.",
        ),
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
            from projections.surfaces.serve import Pools

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
