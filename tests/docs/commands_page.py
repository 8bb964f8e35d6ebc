"""docs/commands.md, written from what ``mapfold --help`` knows, so that it cannot go stale.

``scripts/update_docs`` writes it; a test holds it to the commands.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from projections.cli import command_line

PAGE = Path(__file__).parents[2] / "docs" / "commands.md"

HEAD = """\
# Commands

Data goes to stdout (`--json` gives one JSON document or JSON lines), what is for people to stderr.
Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings · 130 interrupted (Ctrl-C)
· 141 the reader of stdout left before everything was printed (`… | head`) · 143 terminated
(SIGTERM). What runs until it is stopped, such as `record`, exits with 0 or 3 when it is stopped.

`W` is a point in a log: a number of events, an ISO time, `RUN:KEYFRAME`, or `end`. `--at N` means
after the first N events; a time or a keyframe means including it. Where stamps run backwards in a
log, a line says how many events of later times a time takes in.

This page is made from the commands themselves by `scripts/update_docs`.
"""


def commands() -> Iterator[tuple[str, Any]]:
    """Every command that does something, with its full name, in the order of ``--help``."""
    yield from _leaves("mapfold", typer.main.get_command(command_line()))


def _leaves(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    children = getattr(command, "commands", None)
    if children is None:
        yield name, command
        return
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    start = " ".join([name, *map(_usage, arguments)])
    for child_name, child in children.items():
        yield from _leaves(f"{start} {child_name}", child)


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(_section(name, command) for name, command in commands())])


def _section(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
    usage = " ".join([name, *map(_usage, arguments), *(["[OPTIONS]"] if options else [])])
    said = inspect.cleandoc(command.help).replace("\b\n", "")  # a mark to click: do not wrap
    lines = [f"## {name}", "", said, "", f"    {usage}", ""]
    rows = [f"| `{_cell(_name(p))}` | {_cell(p.help)} |" for p in arguments]
    rows += [f"| `{_cell(_flags(p))}` | {_cell(p.help)} |" for p in options]
    if rows:
        lines += ["| | |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def _usage(argument: Any) -> str:
    name: str = _name(argument).rstrip("…") + ("…" if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def _name(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _flags(option: Any) -> str:
    flags = ", ".join([*option.opts, *option.secondary_opts])
    return flags if option.is_flag else f"{flags} {_name(option)}"


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
