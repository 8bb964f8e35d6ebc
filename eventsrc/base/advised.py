"""Command lines that messages advise, made by `advised` so that they can be pasted into a shell.

The code that raises an error does not have the options of the running command. So the program sets
one function that adds them (`complete_by`). In programs other than ``mapfold`` nothing is added,
and LOG stands for the log.
"""

import shlex
from collections.abc import Callable, Collection, Sequence

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
