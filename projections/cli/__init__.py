"""The ``mapfold`` program: its commands and its entry point.

This module imports only what the interpreter has loaded already: before `main` runs, Ctrl-C would
print a traceback.
"""

import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import typer

COMMANDS: "Mapping[str, str]" = {
    "demo": "projections.cli.demo",
    "record": "projections.cli.recording",
    "router": "projections.cli.recording",
    "simulate": "projections.cli.simulate",
    "detect": "projections.cli.detect",
    "spool": "projections.cli.spool",
    "import": "projections.cli.import_",
    "log": "projections.cli.log",
    "replay": "projections.cli.databases",
    "tail": "projections.cli.databases",
    "status": "projections.cli.db",
    "db": "projections.cli.db",
    "fleet": "projections.cli.fleet",
    "state": "projections.cli.maps",
    "draw": "projections.cli.maps",
    "export": "projections.cli.export",
    "foxglove": "projections.cli.export",
    "relocalize": "projections.cli.relocalize",
    "reembed": "projections.cli.reembed",
    "evaluate": "projections.cli.evaluate",
    "query": "projections.cli.query",
    "serve": "projections.cli.serve",
    "ui": "projections.cli.ui",
    "merges": "projections.cli.time_travel",
    "why": "projections.cli.time_travel",
    "diff": "projections.cli.time_travel",
    "bisect": "projections.cli.time_travel",
    "whatif": "projections.cli.whatif",
    "calibrate": "projections.cli.calibrate",
    "edit": "projections.cli.edit",
    "edits": "projections.cli.edit",
    "completion": "projections.cli.shell",
    "help": "projections.cli.shell",
}
"""The module of each command, in the order of ``--help``; commands of one module are adjacent."""


def command_line(names: "Iterable[str]" = tuple(COMMANDS)) -> "typer.Typer":
    """The program with these commands."""
    from .program import compose  # here: it imports typer

    return compose(names, COMMANDS)


def main() -> None:
    """Entry point of the ``mapfold`` program; it ends by SystemExit."""
    try:
        from .program import start
    except KeyboardInterrupt:
        os.write(2, b"mapfold: interrupted\n")
        os._exit(130)
    start(command_line, COMMANDS)
