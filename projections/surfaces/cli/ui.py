"""``mapfold ui``: the web debugger of a log, until a signal."""

import secrets
import webbrowser
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final
from urllib.parse import urlencode

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader

from .folded_log import CachedLog, FoldSettings, W, point
from .options import VectorsOption, ZenohClient, option
from .signals import stop_on_signals
from .terminal import say

if TYPE_CHECKING:
    from collections.abc import Callable

    from projections.history.timeline import SettingsChoice
    from projections.surfaces.ui.editor import Editor
    from projections.surfaces.ui.question_threads import UiService

_EVERY_ADDRESS: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  not a bind
"""The address of this machine for a server that listens on all addresses."""
_KINDS: Final = ("place", "object", "keyframe", "merge")
"""Values of ``--select``."""


def ui(
    *,
    host: Annotated[
        str, option("ADDRESS", "Address to listen on; other machines need the printed token.")
    ] = "127.0.0.1",
    port: Annotated[int, option("N", "0 takes a free one.", min=0, max=65_535)] = 0,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    at: Annotated[
        str | None, option("W", f"Print the link to this moment, as known then: {W}.")
    ] = None,
    select: Annotated[
        str | None,
        option(
            "THING",
            "Print the link to the history of this: place:ID, object:ID, keyframe:RUN/ID or"
            " merge:OFFSET.",
        ),
    ] = None,
    allow_edits: Annotated[
        bool, typer.Option("--allow-edits", help="Let the page record corrections in the log.")
    ] = False,
    truth: Annotated[
        list[Path] | None, option("FILE", "Score other settings against this truth.", "--truth")
    ] = None,
    allow_host: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Name by which browsers call this machine, beside its addresses; may be repeated.",
            "--allow-host",
        ),
    ] = None,
    export_html: Annotated[
        Path | None,
        option(
            "FILE",
            "Instead of serving write one page of the map at all moments, which needs no server.",
            "--export-html",
        ),
    ] = None,
    db: Annotated[str | None, option("URL", "Show how far behind this database is.")] = None,
    vector_db: VectorsOption = None,
    client: ZenohClient,
    source: CachedLog,
) -> None:
    """Show a log's map in a browser, at any point in time.

    The map at every moment, merges and their causes, changes, and the map under other settings.
    Only this machine can connect unless --host says otherwise. Ctrl-C ends it.
    """
    log, settings = source.log, source.checked()
    if vector_db is not None and db is None:
        raise MisuseError("--vector-db is for the lag of the tails; give --db URL too")
    with LogReader(log) as reader:  # errors of log and options come before anything is served
        shown_first = _moment(None if at is None else point(reader, at), select)
    try:
        from projections.surfaces.serve.guard import Guard, SafeHeaders
        from projections.surfaces.serve.listening import bind, is_loopback, serving
        from projections.surfaces.ui.app import HEADERS, create_app
        from projections.surfaces.ui.token_gate import TokenGate
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold ui needs {error.name}, which is not installed; pip install 'mapfold[ui]'"
        ) from None
    if export_html is not None:
        if open_ or allow_edits or truth or allow_host or db is not None:
            raise MisuseError("--export-html serves nothing; give it with --at, --select or --set")
        _export(source, settings, export_html, shown_first)
        return
    from projections.localize.evaluate.truth import read_truth
    from projections.surfaces.ui.live_watch import LiveWatch
    from projections.surfaces.ui.log_map import Opened
    from projections.surfaces.ui.question_threads import UiService

    scored = read_truth(truth) if truth else None
    with ExitStack() as stack:
        listener = stack.enter_context(closing(bind(host, port, "--host or --port")))
        local = is_loopback(listener)
        stop = stack.enter_context(stop_on_signals())
        tails = None if db is None else _tails(stack, log, db, vector_db)
        opened = Opened(
            log,
            settings,
            sets=tuple(source.assignments),
            settings_file=source.settings_file,
            truth_files=tuple(truth or ()),
            truth=scored,
            edits=allow_edits,
            token_needed=not local,
            cache=not source.no_cache,
        )
        service = stack.enter_context(UiService(opened))
        watch = stack.enter_context(LiveWatch(service, tails))
        token = None if local and not allow_edits else secrets.token_urlsafe(24)
        editor = _editor(service, client) if allow_edits else None
        app = create_app(service, watch, editor)
        gate = TokenGate(app, token, everything=not local)
        guarded = SafeHeaders(Guard(gate, hosts=(host, *(allow_host or ()))), HEADERS)
        bound = stack.enter_context(serving(guarded, listener, note=say))
        # Before the server, which waits for its streams and answers to end.
        stack.callback(watch.close)
        stack.callback(service.end)
        name = _EVERY_ADDRESS.get(host, host)
        shown = f"[{name}]" if ":" in name else name
        url = f"http://{shown}:{bound}/" + ("" if token is None else f"?token={token}")
        url += shown_first
        if not local:
            say(f"warning: others can reach {host}; anybody with the link below can read the log")
        say(f"showing {log} at {url}")
        if name != host:
            say(f"from another machine, put an address of this one in the link instead of {name}")
        say("Ctrl-C ends it")
        if open_:
            webbrowser.open(url)
        stop.wait()
    say("page closed")


def _export(source: CachedLog, settings: "SettingsChoice", file: Path, shown_first: str) -> None:
    """Write the page, and say where it is."""
    from projections.surfaces.ui.log_map import LogMap, Opened
    from projections.surfaces.ui.saved_page import write_page

    opened = Opened(
        source.log,
        settings,
        sets=tuple(source.assignments),
        settings_file=source.settings_file,
        cache=not source.no_cache,
    )
    with LogMap(opened) as shown:
        shown.refresh()
        size = write_page(shown, file)
        for problem in shown.problems:
            say(f"warning: {problem}")
    address = file.resolve().as_uri()
    say(f"wrote {address}{shown_first}, {size / 1e6:.1f} MB: open it in a browser or send it")


def _moment(at: Offset | None, select: str | None) -> str:
    """The part of the page's address that leads to a moment and a thing. Raises MisuseError."""
    parts = {} if at is None else {"at": str(at), "known": "then"}
    if select is not None:
        kind, _, name = select.partition(":")
        if kind not in _KINDS or not name:
            raise MisuseError(
                f"--select {select!r} names nothing; write place:ID, object:ID, keyframe:RUN/ID or"
                " merge:OFFSET"
            )
        parts |= {"select": select, "panel": "why"}
    return "#" + urlencode(parts, safe=":/") if parts else ""


def _editor(service: "UiService", client: ZenohClient) -> "Editor":
    """Records commands, through a recorder where one holds the log."""
    from projections.surfaces.ui.editor import Editor

    from .options import user_at_host

    return Editor(service.opened, service.log_id, client.session, user_at_host())


def _tails(
    stack: ExitStack, log: Path, db: str, vector_db: str | None
) -> "Callable[[], list[dict[str, Any]]]":
    """The status of the databases' sinks, read at each call."""
    from projections.postgres.connection import open_targets
    from projections.postgres.status import projection_status

    targets = stack.enter_context(open_targets(db, vector_db))

    def ask() -> list[dict[str, Any]]:
        found = projection_status(log, targets, FoldSettings().checked())
        return [
            {"sink": s.sink, "condition": s.condition, "lag": s.lag, "note": s.note}
            for s in found.sinks
        ]

    return ask
