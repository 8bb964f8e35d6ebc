"""The ``mapfold`` command: one composition root for both packages' commands.

Nothing is imported here but what every process has loaded: until `main` has begun, Ctrl-C would
show where Python was just then.
"""

import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import typer

COMMANDS: "Mapping[str, str]" = {
    "demo": "projections.cli.demo",
    "record": "projections.cli.record",
    "import": "projections.cli.import_",
    "log": "projections.cli.log",
    "router": "projections.cli.router",
    "simulate": "projections.cli.simulate",
    "replay": "projections.cli.replay",
    "tail": "projections.cli.tail",
    "status": "projections.cli.status",
    "db": "projections.cli.db",
    "state": "projections.cli.state",
    "relocalize": "projections.cli.relocalize",
    "evaluate": "projections.cli.evaluate",
    "query": "projections.cli.query",
    "serve": "projections.cli.serve",
    "draw": "projections.cli.draw",
    "merges": "projections.cli.merges",
    "why": "projections.cli.why",
    "diff": "projections.cli.diff",
    "bisect": "projections.cli.bisect",
    "whatif": "projections.cli.whatif",
}
"""The module of each command, in the order ``--help`` lists them; its ``register`` adds it."""


def command_line(names: "Iterable[str]" = tuple(COMMANDS)) -> "typer.Typer":
    """The program with these commands."""
    from .start import compose  # here, so that `main` is there before typer is

    return compose(names, COMMANDS)


def main() -> None:
    """Entry point of the ``mapfold`` program; it ends by SystemExit."""
    try:
        from .start import start
    except KeyboardInterrupt:
        os.write(2, b"mapfold: interrupted\n")
        os._exit(130)
    start(command_line, COMMANDS)
