"""`mapfold router`: a Zenoh router in the foreground."""

import typer

from eventsrc.transport.session import Router

from .options import ConfigOption, ConnectOption, ListenOption, zenoh_options
from .signals import stop_on_signals
from .terminal import say


def router(
    listen: ListenOption = None, connect: ConnectOption = None, zenoh_config: ConfigOption = None
) -> None:
    """Run a Zenoh router in this process until Ctrl-C.

    It listens on tcp/127.0.0.1:7447 unless --listen or a configuration file says otherwise.
    --connect links it to other routers.
    """
    options = zenoh_options(connect, listen, zenoh_config)
    with stop_on_signals() as stop, Router(options) as running:
        say(f"router listening on {', '.join(running.endpoints)}; Ctrl-C ends it")
        stop.wait()
    say("router ended")


def register(app: typer.Typer) -> None:
    """Add `router` to ``app``."""
    app.command()(router)
