"""The program made of its commands, and what every command gets without code of its own:

* options in groups: a dataclass whose fields are options and arguments that several commands share,
  and whose methods are what they are for. A command takes a group as one keyword parameter;
  `flattened` gives typer its fields instead. The options of a group stand where the group stands,
  its arguments before those of the command;
* paths that are neither empty nor too long;
* advice that can be pasted: the running command's options are added to the command lines that its
  messages advise. Such a line needs the same log, settings and databases: a fault that a check
  found under ``--settings F`` is repaired only under these settings.
"""

import contextlib
import dataclasses
import errno
import functools
import importlib
import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import ArgumentInfo

from eventsrc.base.object_store import is_store_url
from eventsrc.base.text import complete_by, shorten_by

from . import COMMANDS, SECTIONS

MAX_NAME: Final = 80
"""Characters of a path in a message."""
# typer's own class or click's, depending on typer's version.
_UsageError: Any = typer.BadParameter.__base__
_DATABASE_OPTION: Final = re.compile(r"--(vector-)?db\b")
_SECRET: Final = re.compile(r"://|password", re.IGNORECASE)
_KEYWORD = inspect.Parameter.KEYWORD_ONLY
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
_SETTINGS: Final = frozenset({"--settings", "--preset", "--set"})
_MAKES_LOGS: Final = frozenset({"import", "record", "simulate", "detect"})
"""Commands whose settings are what a new log says, not those of a fold."""
_ANSWERS_OTHERS: Final = frozenset({"serve", "ui"})
"""Commands whose messages are also sent to other machines, which must not get the databases'
URLs."""
_LOG: Final = "log"

_running: list[Any] = []
"""The click contexts of running commands: one, or none."""


def compose(names: Iterable[str], places: Mapping[str, str]) -> typer.Typer:
    """The program with these commands. ``places`` says for each its module and the name of its
    function or group there."""
    app = typer.Typer(
        name="mapfold",
        cls=Program,
        help="A robot's semantic map as a deterministic fold over an append-only log.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["--help", "-h"]},
    )
    app.callback()(_main_options)
    for name in names:
        module, _, attribute = places[name].partition(":")
        found = getattr(importlib.import_module(f".{module}", __package__), attribute)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name)(found)
    _complete_commands(app)
    return app


def _complete_commands(app: typer.Typer) -> None:
    """Give typer the options of groups, refuse empty paths, have each command complete the command
    lines that it advises, and list its whole first sentence, which typer would cut."""
    for command in app.registered_commands:
        said = inspect.getdoc(command.callback) or ""
        command.short_help = said.split("\n\n")[0].replace("\n", " ")
        command.cls = AdvisingCommand
        if command.callback is not None:
            command.callback = flattened(command.callback)
            _refuse_empty_paths(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            of_all = group.typer_instance.registered_callback
            if of_all is not None and of_all.callback is not None:
                _refuse_empty_paths(of_all.callback)
            group.short_help = group.typer_instance.info.help
            _complete_commands(group.typer_instance)


def flattened(command: Callable[..., Any]) -> Callable[..., Any]:
    """``command`` with the fields of its groups as parameters; itself if it has no group."""
    own = inspect.signature(command, eval_str=True).parameters.values()
    groups = {p.name: list(_fields(p.annotation)) for p in own if _is_group(p.annotation)}
    if not groups:
        return command
    kinds = {p.name: p.annotation for p in own}

    @functools.wraps(command)
    def run(**values: Any) -> Any:
        for name, fields in groups.items():
            values[name] = kinds[name](**{field.name: values.pop(field.name) for field in fields})
        return command(**values)

    shared = [field for fields in groups.values() for field in fields if _is_argument(field)]
    others = (each for parameter in own for each in groups.get(parameter.name, [parameter]))
    parameters = shared + [each.replace(kind=_KEYWORD) for each in others if each not in shared]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def _fields(group: Any) -> Iterator[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    for field in dataclasses.fields(group):
        missing = field.default is dataclasses.MISSING
        default = inspect.Parameter.empty if missing else field.default
        yield inspect.Parameter(field.name, _KEYWORD, default=default, annotation=hints[field.name])


def _is_argument(parameter: inspect.Parameter) -> bool:
    found = getattr(parameter.annotation, "__metadata__", ())
    return any(isinstance(each, ArgumentInfo) for each in found)


class _GivenPath(type(Path())):  # type: ignore[misc]
    """Makes the Path of an option or argument, neither empty (``Path("")`` would be the working
    folder, so ``--out=$UNSET`` would name that) nor longer than the system takes."""

    def __new__(cls, text: str | Path) -> Path:  # type: ignore[misc]
        if text == "":
            raise typer.BadParameter("the path is empty")
        try:
            os.lstat(text)
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                raise typer.BadParameter(f"{str(text)[:MAX_NAME]}…: {error.strerror}") from None
        return Path(text)

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> Any:  # newer versions of typer call it
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(cls)


class _GivenLog(_GivenPath):
    """Makes the path of a log; for the URL of an archive, of a log that reads it."""

    def __new__(cls, text: str | Path) -> Path:  # type: ignore[misc]
        return log_of(str(text)) if is_store_url(str(text)) else _GivenPath(text)


def log_of(url: str) -> Path:
    """A log that reads the archive at ``url``, in the home of mapfold."""
    from eventsrc.log.away import archived_log
    from projections.postgres.embedded import mapfold_home

    return archived_log(url, mapfold_home())


def _refuse_empty_paths(command: Callable[..., Any]) -> None:
    """Make every path of a command a `_GivenPath`, and that of a log a `_GivenLog`."""
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        if _has_path(parameter.annotation):
            for note in parameter.annotation.__metadata__:
                is_log = note.metavar == "LOG"
                note.path_type = _GivenLog if is_log else _GivenPath


def _has_path(annotation: Any) -> bool:
    return annotation is Path or any(map(_has_path, get_args(annotation)))


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # it takes as long to import as typer does

        sys.stdout.write(f"mapfold {version('mapfold')}\n")
        raise typer.Exit


def _main_options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version",
            "-V",
            help="Print the version and exit.",
            callback=_print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:  # without a callback typer would drop the name of a single command
    pass


class Interrupted(Exception):
    """Ctrl-C."""


class ReaderGone(Exception):
    """The reader of stdout has closed it: ``mapfold log cat L | head``."""


@contextlib.contextmanager
def _exceptions_passed_on() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted from None
    except BrokenPipeError:
        raise ReaderGone from None
    except _UsageError as error:
        message = error.message.removeprefix("Value error, ")
        error.message = _without_secrets(message, sys.argv)
        raise


def _without_secrets(message: str, arguments: Sequence[str]) -> str:
    """A usage error's message without words that may be a database's URL or a part of one.

    A URL without quotes is split at its spaces: ``--db host=h password=…`` leaves an argument that
    no command takes.
    """
    split = "extra argument" in message and any(_DATABASE_OPTION.match(a) for a in arguments)
    if not split and not _SECRET.search(message):
        return message
    head = re.split(r"[('\"]", message, maxsplit=1)[0].rstrip()
    return f"{head} (not shown, it may hold a password)".lstrip()


class Program(TyperGroup):
    """The group of all commands."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """As typer does it; ``--help`` prints from in here."""
        with _exceptions_passed_on():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """As typer does it."""
        with _exceptions_passed_on():
            return super().invoke(ctx)

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 (click calls it so)
        """The names of the commands, in the order of their sections."""
        return [name for name in COMMANDS if name in self.commands]

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 (as above)
        """Write the list of commands for ``--help``, by section."""
        longest = max(map(len, self.commands), default=0)
        width = formatter.width - 6 - longest
        for title, names in SECTIONS.items():
            commands = [(name, self.commands[name]) for name in names if name in self.commands]
            if commands:
                with formatter.section(title):
                    formatter.write_dl(
                        [(f"{k:{longest}}", v.get_short_help_str(width)) for k, v in commands]
                    )


class AdvisingCommand(TyperCommand):
    """A command that completes the command lines that are advised while it runs."""

    def invoke(self, ctx: Any) -> Any:
        """As typer does it."""
        _running.append(ctx)
        complete_by(_options_in_force)
        shorten_by(None)  # until the command has a map; its errors are printed after it
        try:
            return super().invoke(ctx)
        finally:
            _running.pop()
            complete_by(None)


def _options_in_force(words: Sequence[str], without: Collection[str]) -> list[str]:
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
    if not _MAKES_LOGS.isdisjoint({context.info_name, words[0]}):
        left_out |= _SETTINGS
    if context.info_name in _ANSWERS_OTHERS:
        left_out |= _DATABASES
    for option in _CARRIED:
        wanted = option in known & given.keys() and option not in left_out
        if wanted and _is_given(context, given[option]):
            added += _as_words(option, context.params[given[option]])
    return added


def _log_of(context: Any) -> Any:
    """The log of the running command, or of the group that it is in. Where ``--db`` stands for a
    log that may be left out, the first argument is what is asked."""
    while context is not None:
        is_left_out = context.params.get("db") is not None and any(
            each.name == _LOG and each.param_type_name == "argument" and not each.required
            for each in context.command.params
        )
        if context.params.get(_LOG) is not None and not is_left_out:
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
