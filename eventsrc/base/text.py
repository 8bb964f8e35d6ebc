r"""Text for people: numbers with a noun, rows under a header, advised command lines, and text from
outside made safe to print.

Escape sequences, which begin with a C0 or C1 control, can move a terminal's cursor, set its title
or type answers; bidirectional overrides and isolates show a name in another order than it has; a
line break in a name forges a line. mapfold prints none of these except its own line ends, so they
are shown as escapes: ``\x1b``, ``\u202e``, ``\n``.

Messages advise command lines, made by `advised` so that they can be pasted into a shell. The code
that raises an error does not have the options of the running command. So the program sets one
function that adds them (`complete_by`). In programs other than ``mapfold`` nothing is added, and
LOG stands for the log.

Texts name things by whole ids. What prints them sets the function that shortens these ids
(`shorten_by`, `shortening`): tables apply it to their cells, `shortened` to other text.
"""

import contextlib
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextvars import ContextVar
from typing import Final


def counted(number: int, word: str) -> str:
    """``1 keyframe``, ``2 keyframes``, ``3,000 keyframes``."""
    return f"{number:,} {word}" if number == 1 else f"{number:,} {word}s"


def table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, right: Collection[str] = ()
) -> str:
    """Rows under the header in columns two spaces apart; ``right`` names those aligned right."""
    cells = [list(header), *([shortened(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    to_right = [name in right for name in header]
    lines = (
        "  ".join(
            cell.rjust(width) if flush else cell.ljust(width)
            for cell, width, flush in zip(row, widths, to_right, strict=True)
        ).rstrip()
        for row in cells
    )
    return "".join(f"{line}\n" for line in lines)


Shorten = Callable[[str], str]
"""Receives a text; returns it with shorter ids."""

_shorten: ContextVar[Shorten | None] = ContextVar("shorten", default=None)


def shorten_by(shorten: Shorten | None) -> None:
    """Set the function that shortens ids in texts of this thread; None leaves them as they are."""
    _shorten.set(shorten)


@contextlib.contextmanager
def shortening(shorten: Shorten) -> Iterator[None]:
    """Shorten ids by this function inside."""
    before = _shorten.set(shorten)
    try:
        yield
    finally:
        _shorten.reset(before)


def shortened(text: str) -> str:
    """``text`` with ids as short as the function of `shorten_by` makes them."""
    shorten = _shorten.get()
    return text if shorten is None else shorten(text)


_UNSAFE: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # C0, DEL, C1
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # bidirectional marks, overrides, isolates
    "\u2028\u2029\ufeff]"  # line and paragraph separator, byte order mark
)


MOST_DIGITS: Final = 19
"""No offset, id or time in nanoseconds has more."""


def whole_number(digits: str) -> int:
    """The whole number that ``digits`` says; one of more than `MOST_DIGITS` is 10**19, with its
    sign, which is larger than all that is counted. Python raises ValueError from 4,300 digits on.
    """
    negative = digits.startswith("-")
    significant = digits.removeprefix("-").lstrip("0") or "0"
    size = 10**MOST_DIGITS if len(significant) > MOST_DIGITS else int(significant)
    return -size if negative else size


def visible(text: str) -> str:
    """``text`` (a key, a name, a path) on one line, with control characters as escapes."""
    return text if text.isprintable() else _UNSAFE.sub(_escaped, text)


def visible_lines(text: str) -> str:
    """``text`` with line breaks kept and all other control characters as escapes. Apply `visible`
    to text from outside first, or it can add lines."""
    return "\n".join(map(visible, text.split("\n")))


def visible_json(text: str) -> str:
    """JSON ``text``, indented or not, with control characters as JSON escapes of the same value."""
    if text.isascii() and "\x7f" not in text:
        return text  # JSON itself escapes C0
    return "\n".join(_UNSAFE.sub(_escaped_in_json, line) for line in text.split("\n"))


def _escaped(match: re.Match[str]) -> str:
    return ascii(match[0])[1:-1]


def _escaped_in_json(match: re.Match[str]) -> str:
    return f"\\u{ord(match[0]):04x}"


Complete = Callable[[Sequence[str], Collection[str]], Sequence[str]]
"""Receives the words of a command line and the options not to be added; returns the words to
append."""


class _Completion:
    """The function that completes command lines; None adds nothing."""

    by: Complete | None = None


def complete_by(complete: Complete | None) -> None:
    """Set the function by which `advised` completes command lines; None adds nothing."""
    _Completion.by = complete


def advised(*words: object, without: Collection[str] = ()) -> str:
    """``mapfold WORDS…``, quoted for a shell, with those options of the running command that this
    one takes too (log, settings, databases), except the options ``without``."""
    given = [str(word) for word in words]
    added = () if _Completion.by is None else _Completion.by(given, without)
    return command_line(*given, *added)


def command_line(*words: object) -> str:
    """``mapfold WORDS…``, quoted for a shell, with nothing added."""
    return shlex.join(["mapfold", *map(str, words)])
