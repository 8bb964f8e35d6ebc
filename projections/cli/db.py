"""``mapfold db``: the embedded server, and whether the databases still agree with the log."""

from typing import Annotated

import typer

from eventsrc.cli._shell import emit, say
from projections.postgres.embedded import EmbeddedServer

group = typer.Typer(help="The embedded PostgreSQL server.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def register(app: typer.Typer) -> None:
    """Add ``db`` to ``app``."""
    app.add_typer(group, name="db")


@group.command()
def url(as_json: JsonOption = False) -> None:
    """Print the embedded server's URL (it answers while the server runs: see db start)."""
    server = EmbeddedServer()
    running = server.running
    if as_json:
        emit({"url": server.url, "data": str(server.data), "running": running, "kept": server.kept})
        return
    typer.echo(server.url)
    if not running:
        say("the server is not running; start it with: mapfold db start")


@group.command()
def start(as_json: JsonOption = False) -> None:
    """Start the embedded server and leave it running until db stop."""
    server = EmbeddedServer().start(keep=True)
    address = server.url
    server.stop()
    if as_json:
        emit({"url": address, "data": str(server.data), "running": True, "kept": True})
        return
    typer.echo(address)
    say(f"running, with its data in {server.data}; stop it with: mapfold db stop")


@group.command()
def stop(as_json: JsonOption = False) -> None:
    """Stop the embedded server, unless another command is using it right now."""
    server = EmbeddedServer()
    still = server.stop(discard_keep=True)
    if as_json:
        emit({"data": str(server.data), "running": still, "kept": False})
    elif still:
        say("another command is using the server; it stops when that command ends")
    else:
        say("stopped")
