"""docs/commands.md and the man page, written from what ``mapfold --help`` knows.

``scripts/update_docs`` writes them; a test holds them to the commands.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from projections.surfaces.cli import command_line

PAGE = Path(__file__).parents[2] / "docs" / "commands.md"
MAN_PAGE = Path(__file__).parents[2] / "projections" / "surfaces" / "cli" / "mapfold.1"

HEAD = """\
# Commands

Data goes to stdout (`--json` gives one JSON document or JSON lines), what is for people to stderr.
Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings · 130 interrupted (Ctrl-C)
· 141 the reader of stdout left before everything was printed (`… | head`) · 143 terminated
(SIGTERM), 129 hung up (SIGHUP). What runs until it is stopped, such as `record`, exits with 0 or 3
when it is stopped.
What takes longer than a second shows a progress bar where stderr is a terminal.

`W` is a point in a log: a number of events, an ISO time, `RUN:KEYFRAME`, or `end`. `--at N` means
after the first N events; a time or a keyframe means including it. Where stamps run backwards in a
log, a line says how many events of later times a time takes in.

A place or object may be called, first one that fits: by its id; by the name that `edit name-place`
gave; shortly, `p3`, or six or more of the first characters of an object's id, with or without
`obj-`; by a type of room, such as `kitchen`; by a class. Case matters in ids only. Where several
fit, an error lists them with what tells them apart. Text names things by ids that are as short as
the map allows; JSON has whole ids.

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
    for child_name in command.list_commands(None):
        yield from _leaves(f"{start} {child_name}", children[child_name])


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(_section(name, command) for name, command in commands())])


def _section(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
    usage = " ".join([name, *map(_usage, arguments), *(["[OPTIONS]"] if options else [])])
    said = inspect.cleandoc(command.help).replace("\b\n", "")  # a mark to click: do not wrap
    lines = [f"## {name}", "", said, "", f"    {usage}", ""]
    rows = [f"| `{_cell(_name(p))}` | {_cell(_help(p))} |" for p in arguments]
    rows += [f"| `{_cell(_flags(p))}` | {_cell(_help(p))} |" for p in options]
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


def _help(parameter: Any) -> str:
    """The help text with the default behind it, as ``--help`` shows it."""
    default = parameter.default
    shown = parameter.show_default
    if getattr(parameter, "is_flag", False):  # --gaps and --no-gaps; --json alone has none to show
        shown = shown and bool(parameter.secondary_opts)
        default = (parameter.opts if default else parameter.secondary_opts or [""])[0].lstrip("-")
    if not shown or default is None or default == "" or callable(default):
        return str(parameter.help or "")
    return f"{parameter.help} [default: {getattr(default, 'value', default)}]"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def man_page() -> str:
    """The page for man(1), in roff; see man-pages(7) and groff_man(7)."""
    about = [
        '.TH MAPFOLD 1 "" "mapfold" "User Commands"',
        ".SH NAME",
        "mapfold \\- a robot's semantic map as a fold over an append-only log",
        ".SH SYNOPSIS",
        ".B mapfold",
        ".I COMMAND",
        "[ARGS]",
        ".SH DESCRIPTION",
        *(line for part in HEAD.split("\n\n")[1:-1] for line in (".PP", _roff(part))),
        ".SH COMMANDS",
    ]
    return "\n".join([*about, *(_man_section(name, each) for name, each in commands())]) + "\n"


def _man_section(name: str, command: Any) -> str:
    lines = [f'.SS "{_roff(name)}"']
    for part in inspect.cleandoc(command.help).split("\n\n"):
        if part.startswith("\b\n"):
            lines += [".PP", ".nf", _roff(part[2:]), ".fi"]
        else:
            lines += [".PP", _roff(part)]
    for each in command.params:
        if each.name == "help":
            continue
        is_argument = each.param_type_name == "argument"
        lines += [".TP", f".B {_roff(_name(each) if is_argument else _flags(each))}"]
        lines.append(_roff(_help(each)))
    return "\n".join(lines)


def _roff(text: str) -> str:
    """Text as it is: hyphens to type, no requests at the start of a line."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("`", "")
    lines = (rf"\&{line}" if line[:1] in (".", "'") else line for line in escaped.split("\n"))
    return "\n".join(line.rstrip() for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    MAN_PAGE.write_text(man_page(), encoding="utf-8")
