"""Running the commands as a program: what ends it early, and what it exits with.

typer would answer Ctrl-C with an empty line and a closed pipe with exit 1, before anybody else
hears of them; `Program` hands both through to `run_app` as what they are.

Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings · 130 interrupted ·
141 the reader of stdout left before everything was printed · 143 terminated.
"""

import contextlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NoReturn

import typer
from typer.core import TyperGroup

from eventsrc.errors import MapfoldError

from ._shell import EXIT_FAILED, say
from ._streams import OutputLost, give_up_stdout, secure_streams

EXIT_INTERRUPTED: Final = 130
EXIT_READER_GONE: Final = 141
"""What a shell shows of a program that writes to a closed pipe: neither done nor failed."""


# Of typer itself or of click, as typer's version has it.
_UsageError: Any = typer.BadParameter.__base__
_DATABASE: Final = re.compile(r"--(vector-)?db\b")
_SECRET: Final = re.compile(r"://|password", re.IGNORECASE)


class _Interrupted(Exception):
    """Ctrl-C."""


class _ReaderGone(Exception):
    """`mapfold log cat L | head`: the reader has seen enough."""


@contextlib.contextmanager
def _handed_through() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise _Interrupted from None
    except BrokenPipeError:
        raise _ReaderGone from None
    except _UsageError as error:
        told = error.message.removeprefix("Value error, ")  # typer's inside showing
        error.message = _without_secrets(told, sys.argv)
        raise


def _without_secrets(message: str, arguments: Sequence[str]) -> str:
    """A usage error's message without words that may be a database's URL, or a part of one.

    An URL without quotes falls apart at its spaces: ``--db host=h password=…`` leaves an argument
    that no command takes.
    """
    apart = "extra argument" in message and any(_DATABASE.match(a) for a in arguments)
    if not apart and not _SECRET.search(message):
        return message
    head = re.split(r"[('\"]", message, maxsplit=1)[0].rstrip()
    return f"{head} (not shown, it may hold a password)".lstrip()


class Program(TyperGroup):
    """The group of all commands."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """As typer does it; ``--help`` prints from in here."""
        with _handed_through():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """As typer does it."""
        with _handed_through():
            return super().invoke(ctx)


def run_app(app: Callable[..., Any]) -> NoReturn:
    """Run a typer app made of `Program`, and exit: our errors are one line for people."""
    secure_streams()
    code = _exit_code(app)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        give_up_stdout()
    except OutputLost as lost:
        give_up_stdout()
        if code != EXIT_FAILED:
            code = _say_lost(lost)
    sys.exit(code)


def _say_lost(lost: OutputLost) -> int:
    say(f"mapfold: stdout: {lost}; nobody has got all of the output")
    return EXIT_FAILED


def _exit_code(app: Callable[..., Any]) -> int:
    try:
        app()
    except SystemExit as ended:  # how typer ends, also when all is well
        return ended.code if isinstance(ended.code, int) else 0
    except MapfoldError as error:
        say(f"mapfold: {error}")
        return error.exit_code
    except OutputLost as lost:
        return _say_lost(lost)
    except _ReaderGone:
        return EXIT_READER_GONE
    except (_Interrupted, KeyboardInterrupt):
        say("mapfold: interrupted")
        return EXIT_INTERRUPTED
    return 0
