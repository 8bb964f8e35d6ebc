"""The ``mapfold`` program: its start, its standard streams and its exit codes.

Starting. Only the module of the command that was asked for is imported: all of them together take a
third of a second, longer than most commands work. The cyclic garbage collector is off while modules
are imported, and OpenBLAS gets one thread: the matrix products here are too small to be split.

Streams. All three are open: where one was closed (``2>&-``), the next file to be opened, a log's
for example, would get its number and everything that is written to that stream. A failed write to
stdout is OutputLost, so that a full disk there is not reported as a fault of the log that is read;
if the reader has closed the pipe it stays a BrokenPipeError. A failed write to stderr is ignored: a
recorder goes on when the disk of its messages is full or its terminal is gone.

Exit codes: 0 done · 1 failed · 2 misuse · 3 done, with loss or findings · 129 hung up ·
130 interrupted · 141 the reader of stdout left before everything was printed · 143 terminated.
typer itself would answer Ctrl-C with an empty line and a closed pipe with exit 1;
`composition.Program` passes both on to `run_app` as exceptions of their own.
"""

import contextlib
import errno
import gc
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn, TextIO

import typer

from eventsrc.base.errors import MapfoldError, MisuseError

from .composition import MAX_NAME, Interrupted, ReaderGone
from .signals import unwind_on_signals
from .terminal import EXIT_FAILED, OutputLost, ReadingBar, output_begins, say

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

EXIT_INTERRUPTED: Final = 130
EXIT_READER_GONE: Final = 141
"""128 + SIGPIPE, as a shell shows a program that writes to a closed pipe."""

COMPLETION_VARIABLE: Final = "_MAPFOLD_COMPLETE"
"""The environment variable by which a shell asks for completions."""


def start(
    command_line: Callable[[Mapping[str, str]], Callable[..., Any]], commands: Mapping[str, str]
) -> None:
    """Run the command that ``sys.argv`` names; ends by SystemExit.

    ``commands`` is the table of all commands, ``command_line`` makes the program of some of them.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported
    gc.disable()
    if COMPLETION_VARIABLE in os.environ:
        from typer._completion_classes import completion_init

        completion_init()
    with _exit_on_ctrl_c():
        program = command_line(_needed(commands))
    gc.freeze()
    gc.enable()
    try:
        run_app(program)
    finally:
        gc.freeze()  # else the interpreter would search all objects for cycles as it exits


def _needed(commands: Mapping[str, str]) -> Mapping[str, str]:
    """The requested command, or the one that a shell completes; all commands if it is none."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if COMPLETION_VARIABLE in os.environ:
        typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
        found = re.match(r"\s*\S+\s+(\S+)\s", typed)  # the program, and a command and its end
        name = found[1] if found else ""
    if sys.argv[1:] in (["--version"], ["-V"]):
        return {}
    return {name: commands[name]} if name in commands else commands


@contextlib.contextmanager
def _exit_on_ctrl_c() -> Iterator[None]:
    """Ctrl-C during the imports exits at once: an exception could be raised anywhere in them."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is not signal.default_int_handler:  # ignored, or set by the caller of `main`
        yield
        return
    signal.signal(signal.SIGINT, _exit_interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def _exit_interrupted(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"mapfold: interrupted\n")
    os._exit(EXIT_INTERRUPTED)


class _Stdout(io.FileIO):
    def write(self, data: "ReadableBuffer", /) -> int:
        output_begins()
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
    """Replace stdin, stdout and stderr as described above, until the program ends."""
    for number in range(3):
        _open_if_closed(number)
    sys.stdout = _secured(sys.stdout, _Stdout)
    sys.stderr = _secured(sys.stderr, _Stderr)


def discard_stdout() -> None:
    """Redirect stdout to /dev/null, so that the interpreter's flush at exit does not fail too."""
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
    unbuffered = getattr(stream, "write_through", False)  # python -u
    raw = kind(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors="backslashreplace",  # for letters outside the encoding, and bytes of a path
        line_buffering=raw.isatty() or kind is _Stderr or unbuffered,
    )


def run_app(app: Callable[..., Any]) -> NoReturn:
    """Run a typer app made of `Program` and exit; a MapfoldError is one line on stderr."""
    secure_streams()
    code = _exit_code(app)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        discard_stdout()
    except OutputLost as lost:
        discard_stdout()
        if code != EXIT_FAILED:
            code = _report_lost_output(lost)
    sys.exit(code)


def _report_lost_output(lost: OutputLost) -> int:
    say(f"mapfold: stdout: {lost}; the output is not complete")
    return EXIT_FAILED


def _exit_code(app: Callable[..., Any]) -> int:
    try:
        with unwind_on_signals(), ReadingBar():
            app()
    except SystemExit as ended:  # typer raises it after every command
        return ended.code if isinstance(ended.code, int) else 0
    except MapfoldError as error:
        say(f"mapfold: {error}")
        return error.exit_code
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:  # of a name that was given
            raise
        say(f"mapfold: {str(error.filename)[:MAX_NAME]}…: {error.strerror}; check the path")
        return MisuseError.exit_code
    except OutputLost as lost:
        return _report_lost_output(lost)
    except ReaderGone:
        return EXIT_READER_GONE
    except (Interrupted, KeyboardInterrupt):
        signal.signal(signal.SIGINT, _exit_interrupted)  # a second one must not end in a traceback
        say("mapfold: interrupted")
        return EXIT_INTERRUPTED
    return 0


class Shell(StrEnum):
    """A shell whose command line can be completed."""

    bash = "bash"
    zsh = "zsh"
    fish = "fish"


def help_(
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="COMMAND", help="A command, such as db check.", show_default=False),
    ] = None,
) -> None:
    """Show the help of a command, as its --help does."""
    from . import command_line  # here: the module of all commands names this one

    command_line()([*(command or ()), "--help"], prog_name="mapfold")


def completion(
    shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")],
) -> None:
    """Print a script that completes commands and options in a shell.

    \b
        bash   eval "$(mapfold completion bash)"       in ~/.bashrc
        zsh    eval "$(mapfold completion zsh)"        in ~/.zshrc, after compinit
        fish   mapfold completion fish | source        in ~/.config/fish/config.fish
    """
    from typer._completion_shared import get_completion_script

    script = get_completion_script(
        prog_name="mapfold", complete_var=COMPLETION_VARIABLE, shell=shell.value
    )
    sys.stdout.write(f"{script}\n")
