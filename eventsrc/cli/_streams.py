"""The three streams that a program is given, made fit to rely on.

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
import sys
from typing import TYPE_CHECKING, Final, TextIO

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
