"""``mapfold ui``: the web debugger of a log, until a signal."""

import dataclasses
import secrets
import webbrowser
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader

from .options import LogArgument, SetOption, SettingsOption, settings_of
from .signals import stop_on_signals
from .terminal import say


def ui(
    log: LogArgument,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Listen here; others need the printed token.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(metavar="N", min=0, max=65_535, help="0 takes a free one.")
    ] = 0,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    allow_edits: Annotated[
        bool, typer.Option("--allow-edits", help="Let the page record corrections in the log.")
    ] = False,
    truth: Annotated[
        list[Path] | None,
        typer.Option("--truth", metavar="FILE", help="Score other settings against this truth."),
    ] = None,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Look at a log's map in a browser, and drag time.

    The map at every moment, merges and their causes, what changed, what would be under other
    settings. Only this machine can connect unless --host says otherwise. Ctrl-C ends it.
    """
    settings = settings_of(settings_file, set_)
    with LogReader(log):  # a log that cannot be opened is an error before anything is served
        pass
    try:
        from projections.serve.guard import Guard
        from projections.serve.listening import bind, is_loopback, serving
        from projections.ui.app import create_app
        from projections.ui.headers import SafeHeaders
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold ui needs {error.name}, which is not installed; pip install 'mapfold[ui]'"
        ) from None
    from projections.evaluate.truth import read_truth
    from projections.ui.opened import Opened
    from projections.ui.service import UiService

    opened = Opened(
        log,
        settings,
        sets=tuple(set_ or ()),
        settings_file=settings_file,
        truth=read_truth(truth) if truth else None,
        edits=allow_edits,
    )

    with ExitStack() as stack:
        listener = stack.enter_context(closing(bind(host, port)))
        stop = stack.enter_context(stop_on_signals())
        local = is_loopback(listener)
        token = None if local and not allow_edits else secrets.token_urlsafe(24)
        opened = dataclasses.replace(opened, token_needed=not local)
        service = stack.enter_context(UiService(opened))
        guarded = SafeHeaders(Guard(create_app(service), None if local else token, (host,)))
        bound = stack.enter_context(serving(guarded, listener, tell=say))
        shown = f"[{host}]" if ":" in host else host
        url = f"http://{shown}:{bound}/" + ("" if token is None else f"#token={token}")
        say(f"showing {log} at {url}")
        say("Ctrl-C ends it")
        if open_:
            webbrowser.open(url)
        stop.wait()
    say("page closed")


def register(app: typer.Typer) -> None:
    """Add `ui` to the program."""
    app.command()(ui)
