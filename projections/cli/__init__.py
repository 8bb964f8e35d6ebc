"""The ``mapfold`` command: one composition root for both packages' commands."""

import typer

from eventsrc import cli as log_commands
from eventsrc.cli._shell import run_app

from . import (
    bisect,
    db,
    demo,
    diff,
    draw,
    evaluate,
    merges,
    query,
    relocalize,
    replay,
    serve,
    state,
    status,
    tail,
    whatif,
    why,
)

app = typer.Typer(
    name="mapfold",
    help="A robot's semantic map as a deterministic fold over an append-only log.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

demo.register(app)
log_commands.register(app)
replay.register(app)
tail.register(app)
status.register(app)
db.register(app)
state.register(app)
relocalize.register(app)
evaluate.register(app)
query.register(app)
serve.register(app)
draw.register(app)
merges.register(app)
why.register(app)
diff.register(app)
bisect.register(app)
whatif.register(app)


def main() -> None:
    """Entry point of the ``mapfold`` program."""
    run_app(app)
