"""Add the running command's options to the command lines that its messages advise. Such a line
needs the same log, settings and databases: a fault that a check found under ``--settings F`` is
repaired only under these settings.
"""

from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import Any, Final

import typer
from typer.core import TyperCommand

from eventsrc.base.text import complete_by

_CARRIED: Final = (
    "--settings",
    "--preset",
    "--set",
    "--db",
    "--vector-db",
    "--connect",
    "--zenoh-config",
)
"""The options that are added, in order."""
_DATABASES: Final = frozenset({"--db", "--vector-db"})
_ANSWERS_OTHERS: Final = frozenset({"serve", "ui"})
"""Commands whose messages are also sent to other machines, which must not get the databases'
URLs."""
_LOG: Final = "log"

_running: list[Any] = []
"""The click contexts of running commands: one, or none."""


class AdvisingCommand(TyperCommand):
    """A command that completes the command lines that are advised while it runs."""

    def invoke(self, ctx: Any) -> Any:
        """As typer does it."""
        _running.append(ctx)
        complete_by(_complete)
        try:
            return super().invoke(ctx)
        finally:
            _running.pop()
            complete_by(None)


def _complete(words: Sequence[str], without: Collection[str]) -> list[str]:
    """The log, if ``words`` name none and the command takes one, and the options in force."""
    if not _running:
        return []
    command, rest = _command(tuple(words))
    context = _running[-1]
    added = []
    takes_log = any(p.param_type_name == "argument" and p.name == _LOG for p in command.params)
    if takes_log and not _names_something(command, rest):
        added.append(str(_log_of(context) or "LOG"))
    known = {option for param in command.params for option in param.opts}
    given = {param.opts[-1]: param.name for param in context.command.params}
    left_out = {*words, *without}
    if context.info_name in _ANSWERS_OTHERS:
        left_out |= _DATABASES
    for option in _CARRIED:
        wanted = option in known & given.keys() and option not in left_out
        if wanted and _is_given(context, given[option]):
            added += _as_words(option, context.params[given[option]])
    return added


def _log_of(context: Any) -> Any:
    """The log of the running command, or of the group that it is in."""
    while context is not None:
        if context.params.get(_LOG) is not None:
            return context.params[_LOG]
        context = context.parent
    return None


def _names_something(command: Any, words: Sequence[str]) -> bool:
    """Whether there is an argument among ``words``, besides options and their values."""
    flags = {
        option
        for param in command.params
        if getattr(param, "is_flag", False)
        for option in param.opts
    }
    values = 0
    for word in words:
        if word.startswith("--"):
            values = 0 if word in flags else 1
        elif values:
            values = 0
        else:
            return True
    return False


def _is_given(context: Any, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _as_words(option: str, value: Any) -> list[str]:
    from projections.postgres.connection import url_without_secrets

    values = value if isinstance(value, list | tuple) else [value]
    words: list[str] = []
    for each in values:
        text = str(getattr(each, "value", each))
        words += [option, url_without_secrets(text) if option in _DATABASES else text]
    return words


@lru_cache(maxsize=64)
def _command(words: tuple[str, ...]) -> tuple[Any, tuple[str, ...]]:
    """The click command that ``words`` begin with, and the other words: after its name, and the
    arguments of the group that it is in, as in ``edit LOG undo``."""
    from . import command_line  # it imports this module

    command: Any = typer.main.get_command(command_line([words[0]]))
    before: tuple[str, ...] = ()
    while hasattr(command, "commands"):
        arguments = sum(param.param_type_name == "argument" for param in command.params)
        before, words = before + words[:arguments], words[arguments:]
        if not words or words[0] not in command.commands:
            break
        command, words = command.commands[words[0]], words[1:]
    return command, before + words
