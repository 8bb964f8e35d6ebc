"""Command lines that messages advise. `advised` makes all of them, so that they can be pasted into
a shell and run.

A message is made far from the command line: a damaged segment knows its log, not the options that
the running command was given. So the program says once how command lines are completed. In a
program that is not ``mapfold`` nothing is added, and LOG stands for the log.
"""

import shlex
from collections.abc import Callable, Collection, Sequence

Complete = Callable[[Sequence[str], Collection[str]], Sequence[str]]
"""From the words of a command line, and the options that are not to be added to it, to what is to
be put behind them."""


class _Completion:
    """How command lines are completed now."""

    by: Complete | None = None


def complete_by(complete: Complete | None) -> None:
    """Have `advised` complete command lines by this, or by nothing."""
    _Completion.by = complete


def advised(*words: object, without: Collection[str] = ()) -> str:
    """``mapfold WORDS…`` as a shell reads it, with what the running command was given and this one
    takes too: the log, settings, databases; but for the options ``without``."""
    given = [str(word) for word in words]
    added = () if _Completion.by is None else _Completion.by(given, without)
    return command_line(*given, *added)


def command_line(*words: object) -> str:
    """``mapfold WORDS…`` as a shell reads it, with nothing added."""
    return shlex.join(["mapfold", *map(str, words)])
