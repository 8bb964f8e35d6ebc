"""The ``mapfold`` program: its commands and its entry point.

This module imports only what the interpreter has loaded already: before `main` runs, Ctrl-C would
print a traceback.
"""

import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import typer

SECTIONS: "Mapping[str, Mapping[str, str]]" = {
    "Try it": {
        "demo": "projections.cli.demo",
        "simulate": "projections.cli.simulate",
    },
    "Record a log": {
        "record": "projections.cli.recording",
        "router": "projections.cli.recording",
        "detect": "projections.cli.detect",
        "spool": "projections.cli.spool",
        "import": "projections.cli.import_",
        "log": "projections.cli.log",
    },
    "Project it into databases": {
        "replay": "projections.cli.databases",
        "tail": "projections.cli.databases",
        "status": "projections.cli.db",
        "db": "projections.cli.db",
        "fleet": "projections.cli.fleet",
    },
    "Look at the map": {
        "state": "projections.cli.maps",
        "draw": "projections.cli.maps",
        "ui": "projections.cli.ui",
        "query": "projections.cli.query",
        "export": "projections.cli.export",
        "foxglove": "projections.cli.export",
    },
    "Find a robot": {
        "relocalize": "projections.cli.relocalize",
        "serve": "projections.cli.serve",
    },
    "Travel in time": {
        "merges": "projections.cli.time_travel",
        "why": "projections.cli.time_travel",
        "diff": "projections.cli.time_travel",
        "bisect": "projections.cli.time_travel",
        "whatif": "projections.cli.whatif",
    },
    "Correct and measure": {
        "edit": "projections.cli.edit",
        "edits": "projections.cli.edit",
        "evaluate": "projections.cli.evaluate",
        "calibrate": "projections.cli.calibrate",
        "reembed": "projections.cli.reembed",
    },
    "Shell": {
        "completion": "projections.cli.shell",
        "help": "projections.cli.shell",
    },
}
"""The sections of ``--help``, with the commands of each and the module of each command."""

COMMANDS: "Mapping[str, str]" = {
    name: module for commands in SECTIONS.values() for name, module in commands.items()
}
"""The module of each command, in the order of ``--help``."""


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
