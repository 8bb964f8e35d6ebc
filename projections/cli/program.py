"""Running the commands as a program: what ends it early, and what it exits with.

typer would answer Ctrl-C with an empty line and a closed pipe with exit 1, before anybody else
hears of them; `Program` hands both through to `run_app` as what they are.

Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings · 130 interrupted ·
141 the reader of stdout left before everything was printed · 143 terminated.

The three streams that a program is given, made fit to rely on.

* All three are there. Where one was closed (``2>&-``), the next file that is opened would get its
  number, a log's for example, and with it whatever anybody says to that stream.
* What cannot be written to stdout is OutputLost, whoever writes it: a full disk there is no fault
  of the log that is being read. A reader that has left stays a BrokenPipeError.
* What cannot be written to stderr is nobody's loss but the reader's: a recorder goes on recording
  when the file it tells its news to is on a full disk, or its terminal is gone.
"""

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO

import typer
from typer.core import TyperGroup

from eventsrc.errors import MapfoldError

from .terminal import EXIT_FAILED, say

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_ODD_CHARACTERS: Final = "backslashreplace"
"""What the terminal's encoding has no letter for, and bytes of a path that are no text."""


class OutputLost(Exception):
    """Stdout takes no more; the text says why."""


class _Stdout(io.FileIO):
    def write(self, data: "ReadableBuffer", /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputLost(error.strerror or str(error)) from None


class _Stderr(io.FileIO):
    def write(self, data: "ReadableBuffer", /) -> int:
        with contextlib.suppress(OSError):
            return super().write(data)
        return len(memoryview(data))


def secure_streams() -> None:
    """Make stdin, stdout and stderr what is said above, for the life of the program."""
    for number in range(3):
        _open_if_closed(number)
    sys.stdout = _secured(sys.stdout, _Stdout)
    sys.stderr = _secured(sys.stderr, _Stderr)


def give_up_stdout() -> None:
    """Point stdout elsewhere, so that the interpreter's own flush at exit does not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_if_closed(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the lowest free number


def _secured(stream: TextIO | None, kind: type[io.FileIO]) -> io.TextIOWrapper:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123 - until the end
    stream.flush()
    at_once = getattr(stream, "write_through", False)  # python -u
    raw = kind(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=_ODD_CHARACTERS,
        line_buffering=raw.isatty() or kind is _Stderr or at_once,
    )


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
