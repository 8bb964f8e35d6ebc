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
        "demo": "simulate:demo",
        "simulate": "simulate:simulate",
    },
    "Record a log": {
        "record": "record_command:record",
        "router": "record_command:router",
        "detect": "detect:detect",
        "spool": "spool_command:spool",
        "import": "import_:import_",
        "log": "log:log_commands",
    },
    "Project it into databases": {
        "replay": "replay_and_tail:replay",
        "tail": "replay_and_tail:tail_command",
        "status": "db:status",
        "db": "db:group",
        "fleet": "fleet:fleet",
    },
    "Look at the map": {
        "state": "maps:state",
        "draw": "maps:draw",
        "ui": "ui:ui",
        "find": "find_command:find_things",
        "room": "find_command:show_room",
        "path": "find_command:show_path",
        "export": "export_command:export",
        "foxglove": "export_command:foxglove",
        "ros": "ros_command:ros",
    },
    "Find a robot": {
        "relocalize": "relocalize:relocalize",
        "serve": "serve:serve",
        "mcp": "serve:mcp",
    },
    "Travel in time": {
        "merges": "time_travel:merges",
        "why": "time_travel:why",
        "diff": "time_travel:diff",
        "changes": "time_travel:changes",
        "bisect": "time_travel:bisect",
        "whatif": "whatif_command:whatif",
    },
    "Correct and measure": {
        "edit": "edit:edit",
        "edits": "edit:edits",
        "align": "align_command:align",
        "evaluate": "evaluate:evaluate",
        "calibrate": "calibrate:calibrate_command",
        "reembed": "reembed:reembed_log",
    },
    "Shell": {
        "completion": "program:completion",
        "help": "program:help_",
    },
}
"""The sections of ``--help``, with the commands of each. Beside each command stand its module here
and the function or group in it that is the command."""

COMMANDS: "Mapping[str, str]" = {
    name: place for commands in SECTIONS.values() for name, place in commands.items()
}
"""The place of each command, in the order of ``--help``."""


def command_line(names: "Iterable[str]" = tuple(COMMANDS)) -> "typer.Typer":
    """The program with these commands."""
    from .composition import compose  # here: it imports typer

    return compose(names, COMMANDS)


def main() -> None:
    """Entry point of the ``mapfold`` program; it ends by SystemExit."""
    try:
        from .program import start
    except KeyboardInterrupt:
        os.write(2, b"mapfold: interrupted\n")
        os._exit(130)
    start(command_line, COMMANDS)
