"""The point in time of a question about the map: W, ``known_at``, and the equivalent command
line."""

import shlex
from dataclasses import dataclass

from starlette.datastructures import QueryParams

from eventsrc.envelope.model import Offset
from projections.history import KnownHistory

from .log_map import LogMap
from .opened import Opened
from .requests import assignments_of, text_of


@dataclass(frozen=True, slots=True)
class Moment:
    """The map after ``end`` events, under the commands before ``known_at``."""

    shown: LogMap
    query: QueryParams
    end: Offset
    known_at: Offset

    @classmethod
    def of(cls, shown: LogMap, query: QueryParams, name: str = "at") -> "Moment":
        """From the parameters ``at`` (default: the end) and ``known_at`` (default: there)."""
        end = shown.point(text_of(query, name, "end"))
        return cls(shown, query, end, shown.point(text_of(query, "known_at", str(end))))

    @property
    def known(self) -> KnownHistory:
        """The history under the commands before ``known_at``."""
        return self.shown.timeline.knowing(self.known_at)

    def document(self) -> dict[str, int]:
        """The fields that say which map an answer is about."""
        return {"at": self.end, "known_at": self.known_at}

    def command(self, name: str, *arguments: object, asked_at: bool = True) -> str:
        """The command line that gives the same answer; with ``asked_at`` it has ``--at``."""
        words = [*map(str, arguments)]
        if asked_at:
            words += ["--at", str(self.end)]
        span = sorted((self.end, self.known_at))
        if self.shown.timeline.commands(*span):  # else it is the same map without saying it
            words += ["--known-at", str(self.known_at)]
        settings = self.shown.opened.words(*assignments_of(self.query))
        return command_line(self.shown.opened, name, *words, *settings)


def command_line(opened: Opened, name: str, *words: str) -> str:
    """``mapfold NAME LOG …``, quoted for a shell."""
    return shell_line("mapfold", name, str(opened.log), *words)


def shell_line(*words: str) -> str:
    """A command line of printable characters only, for bash and zsh.

    A terminal executes a control character of a pasted line even between quotes: Ctrl-C ends the
    line, and what follows is a command of its own. Characters that change the direction of text
    would display another command. Such a word is written as ``$'…'``.
    """
    return " ".join(map(_quoted, words))


def _quoted(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    return "$'" + "".join(map(_escaped, word)) + "'"


def _escaped(char: str) -> str:
    if char in "'\\":
        return f"\\{char}"
    if char.isprintable():
        return char
    errors = "surrogateescape" if "\udc80" <= char <= "\udcff" else "replace"  # bytes of a path
    return "".join(f"\\{byte:03o}" for byte in char.encode("utf-8", errors))
