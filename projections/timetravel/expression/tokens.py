"""From text to tokens: numbers, quoted texts, names and signs, each with its column from 1.

A text stands in single or double quotes; a backslash before a quote or a backslash takes it as it
is, because ids may hold anything. Nothing else is escaped.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from .errors import ExpressionError

TokenKind = Literal["number", "text", "name", "sign", "end"]

_SPACE = re.compile(r"\s*")
_NUMBER = re.compile(r"-?\d+")
_NAME = re.compile(r"[A-Za-z_]\w*")
_TEXT = re.compile(r"""'((?:[^'\\]|\\['"\\])*)'|"((?:[^"\\]|\\['"\\])*)\"""")
_SIGN = re.compile(r"<=|>=|==|!=|[<>(),]")
_ESCAPE = re.compile(r"\\(.)")


@dataclass(frozen=True, slots=True)
class Token:
    """One word of an expression; ``text`` is its value (unquoted), ``column`` counts from 1."""

    kind: TokenKind
    text: str
    column: int

    def __str__(self) -> str:
        return "the end" if self.kind == "end" else repr(self.text)


def tokenize(source: str) -> Iterator[Token]:
    """The tokens of ``source``, ended by one of kind ``end``; raises ExpressionError."""
    index = _skip_space(source, 0)
    while index < len(source):
        token, index = _token(source, index)
        yield token
        index = _skip_space(source, index)
    yield Token("end", "", len(source) + 1)


def _skip_space(source: str, index: int) -> int:
    match = _SPACE.match(source, index)
    return match.end() if match else index


def _token(source: str, index: int) -> tuple[Token, int]:
    column = index + 1
    if match := _NUMBER.match(source, index):
        return Token("number", match[0], column), match.end()
    if match := _NAME.match(source, index):
        return Token("name", match[0], column), match.end()
    if match := _TEXT.match(source, index):
        quoted = match[1] if match[1] is not None else match[2]
        return Token("text", _ESCAPE.sub(r"\1", quoted), column), match.end()
    if match := _SIGN.match(source, index):
        return Token("sign", match[0], column), match.end()
    raise ExpressionError(source, column, _complaint(source[index]))


def _complaint(char: str) -> str:
    match char:
        case "'" | '"':
            return f"this text is not closed; it needs another {char}"
        case "=":
            return "a single '=' compares nothing; write '=='"
        case "&" | "|" | "!":
            return f"{char!r} is not an operator here; write and, or, not, !="
        case ".":
            return "'.' has no meaning here; numbers are whole"
        case _:
            return f"{char!r} has no meaning here"
