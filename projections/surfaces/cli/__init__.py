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
        "demo": "projections.surfaces.cli.demo",
        "simulate": "projections.surfaces.cli.simulate",
    },
    "Record a log": {
        "record": "projections.surfaces.cli.recording",
        "router": "projections.surfaces.cli.recording",
        "detect": "projections.surfaces.cli.detect",
        "spool": "projections.surfaces.cli.spool",
        "import": "projections.surfaces.cli.import_",
        "log": "projections.surfaces.cli.log",
    },
    "Project it into databases": {
        "replay": "projections.surfaces.cli.databases",
        "tail": "projections.surfaces.cli.databases",
        "status": "projections.surfaces.cli.db",
        "db": "projections.surfaces.cli.db",
        "fleet": "projections.surfaces.cli.fleet",
    },
    "Look at the map": {
        "state": "projections.surfaces.cli.maps",
        "draw": "projections.surfaces.cli.maps",
        "ui": "projections.surfaces.cli.ui",
        "query": "projections.surfaces.cli.query",
        "export": "projections.surfaces.cli.export",
        "foxglove": "projections.surfaces.cli.export",
    },
    "Find a robot": {
        "relocalize": "projections.surfaces.cli.relocalize",
        "serve": "projections.surfaces.cli.serve",
    },
    "Travel in time": {
        "merges": "projections.surfaces.cli.time_travel",
        "why": "projections.surfaces.cli.time_travel",
        "diff": "projections.surfaces.cli.time_travel",
        "bisect": "projections.surfaces.cli.time_travel",
        "whatif": "projections.surfaces.cli.whatif",
    },
    "Correct and measure": {
        "edit": "projections.surfaces.cli.edit",
        "edits": "projections.surfaces.cli.edit",
        "evaluate": "projections.surfaces.cli.evaluate",
        "calibrate": "projections.surfaces.cli.calibrate",
        "reembed": "projections.surfaces.cli.reembed",
    },
    "Shell": {
        "completion": "projections.surfaces.cli.shell",
        "help": "projections.surfaces.cli.shell",
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
