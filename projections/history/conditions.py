"""Parser of conditions over the map, as ``bisect`` takes: ``place_count < 3 and not merged('p0')``.

A condition is a subset of a Python expression: ``and``, ``or``, ``not``, one comparison at a time,
whole numbers, quoted texts, ``none`` and the functions of `condition_functions`; a function without
arguments may be written without parentheses. The standard library's `ast` parses it, and only the
node types named here are accepted; nothing is compiled or evaluated as code. Types are checked
when parsing: a comparison needs two numbers or two texts, texts have only == and !=, and the whole
must be true or false. Each error names its column.

The source is split into tokens first, because `ast` alone refuses what is accepted here: a text
with a line break, a NUL or a lone surrogate in it (ids may hold any character, so a text ends at
its quote, with escapes for a quote and a backslash only), ``007``, digits of other scripts, and
spaces that are not ASCII. What Python allows and a condition does not (``0x10``, ``1.5``, ``# …``)
is an error at its column. `ast` parses the tokens joined by single spaces, so that a node's offset
gives a token and with it a column.
"""

import ast
import functools
import keyword
import operator
import re
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal

from eventsrc.base.errors import MisuseError

from .condition_functions import (
    FUNCTIONS,
    Direction,
    Function,
    HistoryFacts,
    Mention,
    Names,
    Type,
    Value,
    no_function,
)

MAX_DEPTH = 100
"""Greatest depth of parentheses and ``not``; it bounds every recursion over the tree."""
MAX_DIGITS = 4300
"""Most digits of a number: as many as Python converts by default."""

MAX_TOKENS = 2_000
"""Names, numbers, texts and signs of a condition: it is evaluated for each event of a scan."""

_TOKEN = re.compile(
    r"\s*(?:(?P<number>-?\d+)|(?P<name>[A-Za-z_]\w*)|(?P<sign><=|>=|==|!=|[<>(),])"
    r"""|(?P<text>'(?:[^'\\]|\\['"\\])*'|"(?:[^"\\]|\\['"\\])*"))"""
)
_WRONG_SIGNS = {
    **{quote: f"this text is not closed; it needs another {quote}" for quote in "'\""},
    "=": "'=' is not a comparison; write '=='",
    **{sign: f"{sign!r} is not an operator here; write and, or, not, !=" for sign in "&|!"},
    ".": "'.' has no meaning here; numbers are whole",
}
_OPERATOR_WORDS = ("and", "or", "not")
_COMPARISONS: dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
    ast.GtE: (">=", operator.ge),
    ast.Gt: (">", operator.gt),
}


class ExpressionError(MisuseError):
    """A condition that cannot be parsed; ``column`` counts from 1.

    The message is one line like that of every error; a command prints ``pointer`` above it.
    """

    def __init__(self, source: str, column: int, reason: str) -> None:
        super().__init__(f"expression, column {column}: {reason}")
        self.source = source
        self.column = column
        self.reason = reason

    @property
    def pointer(self) -> str:
        """Two lines: the condition, and a caret under the column."""
        return f"  {self.source}\n  {' ' * (self.column - 1)}^"


@dataclass(frozen=True, slots=True)
class _Call:
    function: Function
    mentions: tuple[Mention, ...]
    value: Callable[[HistoryFacts], Value]

    def __str__(self) -> str:
        arguments = ", ".join(repr(mention.text) for mention in self.mentions)
        return f"{self.function.name}({arguments})" if arguments else self.function.name


@dataclass(frozen=True, slots=True)
class _Term:
    """A part of a condition with its type, and the function of a map that gives its value."""

    column: int
    type: Type
    value: Callable[[HistoryFacts], Value]
    direction: Direction = Direction.STEADY
    calls: tuple[_Call, ...] = ()
    text: str | None = None  # of one in quotes


@dataclass(frozen=True, slots=True)
class _Token:
    kind: Literal["number", "text", "name", "sign", "end"]
    text: str
    """A text is without its quotes."""
    column: int

    def __str__(self) -> str:
        return "the end" if self.kind == "end" else repr(self.text)

    @property
    def begins_value(self) -> bool:
        return self.text == "(" if self._is_sign else self.text not in ("and", "or")

    @property
    def ends_value(self) -> bool:
        return self.text == ")" if self._is_sign else self.text not in _OPERATOR_WORDS

    @property
    def _is_sign(self) -> bool:
        return self.kind in ("sign", "end")

    def python(self) -> str:
        """The token as source for `ast`; ASCII only, since offsets count bytes there."""
        match self.kind:
            case "number":
                return str(int(self.text))
            case "text":
                return ascii(self.text)
            case "name" if keyword.iskeyword(self.text) and self.text not in _OPERATOR_WORDS:
                return f"_{self.text}"
            case "name":
                return ascii(self.text)[1:-1].replace("\\", "_")
            case _:
                return self.text


class Expression:
    """A condition over the map, parsed once. Raises ExpressionError for a text that is none."""

    def __init__(self, source: str) -> None:
        self.source = source
        parser = _Parser(source)
        self._term = parser.parse()
        self._compared = tuple(parser.compared)

    def __str__(self) -> str:
        return self.source

    def holds(self, facts: HistoryFacts) -> bool:
        """Whether it is true of this map."""
        return bool(self._term.value(facts))

    def readings(self, facts: HistoryFacts) -> tuple[tuple[str, Value], ...]:
        """Every function call as written, with its value."""
        return tuple({str(call): call.value(facts) for call in self._term.calls}.items())

    @property
    def direction(self) -> Direction:
        """How its truth can change as events are added."""
        return self._term.direction

    def mentions(self) -> tuple[Mention, ...]:
        """The keyframes, places, objects, classes and runs it names."""
        called = (mention for call in self._term.calls for mention in call.mentions)
        return (*called, *self._compared)

    def error_at(self, column: int, reason: str) -> ExpressionError:
        """An error at a column of this condition."""
        return ExpressionError(self.source, column, reason)


class _Parser:
    """Parses one condition; its methods return checked terms or raise ExpressionError."""

    def __init__(self, source: str) -> None:
        self._source = source
        self.compared: list[Mention] = []
        """Texts that are compared with a place."""
        self._tokens = list(islice(self._split(), MAX_TOKENS + 2))
        if len(self._tokens) > MAX_TOKENS + 1:
            raise self._error(self._tokens[MAX_TOKENS], f"more than {MAX_TOKENS:,} words and signs")
        self._check_order()
        words = [token.python() for token in self._tokens]
        self._starts = [0]
        for word in words:
            self._starts.append(self._starts[-1] + len(word) + 1)
        self._text = " ".join(words)

    def parse(self) -> _Term:
        try:
            tree = ast.parse(self._text, mode="eval")
        except SyntaxError as error:
            token = self._tokens[self._index((error.offset or 1) - 1)]
            raise self._error(token, _expected_value(token)) from None
        return self._boolean(self._term(tree.body), "an expression")

    def _split(self) -> Iterator[_Token]:
        index, end = 0, len(self._source.rstrip())
        while index < end:
            match = _TOKEN.match(self._source, index)
            if match is None:
                start = index + len(self._source[index:]) - len(self._source[index:].lstrip())
                char = self._source[start]
                reason = _WRONG_SIGNS.get(char, f"{char!r} has no meaning here")
                raise ExpressionError(self._source, start + 1, reason)
            kind: Any = match.lastgroup
            text = match[kind]
            if kind == "number" and len(text.removeprefix("-")) > MAX_DIGITS:
                reason = f"a number of more than {MAX_DIGITS} digits"
                raise ExpressionError(self._source, match.start(kind) + 1, reason)
            if kind == "text":
                text = re.sub(r"\\(.)", r"\1", text[1:-1], flags=re.DOTALL)
            yield _Token(kind, text, match.start(kind) + 1)
            index = match.end()
        yield _Token("end", "", len(self._source) + 1)

    def _check_order(self) -> None:
        """Check the order of tokens, the pairs of parentheses and the depth of nesting, which
        Python's parser reports at other columns or not at all."""
        open_at: list[tuple[bool, int]] = []  # is it a call, and the depth outside
        depth = 0
        before = _Token("sign", "(", 0)
        called = False
        for token in self._tokens:
            opens_call = token.text == "(" and token.kind == "sign" and before.kind == "name"
            opens_call = opens_call and before.text not in _OPERATOR_WORDS
            closes_empty_call = called and token.kind == "sign" and token.text == ")"
            if before.ends_value and token.begins_value and not opens_call:
                in_call = bool(open_at) and open_at[-1][0]
                raise self._error(token, _expected_end(token, in_call=in_call))
            if not (before.ends_value or token.begins_value or closes_empty_call):
                raise self._error(token, _expected_value(token))
            if token.kind == "sign" and token.text == "(":
                open_at.append((opens_call, depth))
                depth += not opens_call
            elif token.kind == "sign" and token.text == ")":
                if not open_at:
                    raise self._error(token, _expected_end(token))
                depth = open_at.pop()[1]
            elif token.kind == "name" and token.text in ("and", "or"):
                depth = open_at[-1][1] + (not open_at[-1][0]) if open_at else 0
            elif token.kind == "name" and token.text == "not":
                depth += 1
            if depth > MAX_DEPTH:
                raise self._error(token, f"nested more than {MAX_DEPTH} deep")
            before, called = token, opens_call
        if open_at:
            raise self._error(before, f"expected ')' to close the parenthesis, not {before}")

    def _term(self, node: ast.expr) -> _Term:
        match node:
            case ast.Constant() | ast.UnaryOp(op=ast.USub()):
                token = self._token(node)
                number = token.kind == "number"
                constant = int(token.text) if number else token.text
                kind = Type.NUMBER if number else Type.TEXT
                text = None if number else token.text
                return _Term(token.column, kind, lambda _: constant, text=text)
            case ast.Name() if self._token(node).text == "none":
                return _Term(self._token(node).column, Type.TEXT, lambda _: None)
            case ast.Name():
                return self._call(node, ())
            case ast.Call(func=ast.Name() as name, args=arguments):
                return self._call(name, arguments)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                inner = self._boolean(self._term(operand), "the operand of not")
                return _Term(
                    self._token(node).column,
                    Type.BOOLEAN,
                    lambda facts: not inner.value(facts),
                    inner.direction.opposite,
                    inner.calls,
                )
            case ast.BoolOp(op=op, values=values):
                return self._joined(node, isinstance(op, ast.And), values)
            case ast.Compare():
                return self._compared(node)
            case ast.Tuple(elts=[first, *_]):
                token = self._after(first, ",")
                raise self._error(token, _expected_end(token))
            case ast.Call(func=function):
                token = self._after(function, "(")
                raise self._error(token, _expected_end(token))
            case _:
                raise self._error(self._token(node), _expected_value(self._token(node)))

    def _joined(self, node: ast.expr, every: bool, values: list[ast.expr]) -> _Term:
        operand = "an operand of and" if every else "an operand of or"
        terms = [self._boolean(self._term(value), operand) for value in values]
        join = all if every else any
        return _Term(
            self._token(node).column,
            Type.BOOLEAN,
            lambda facts: join(term.value(facts) for term in terms),
            functools.reduce(Direction.joined, (term.direction for term in terms)),
            tuple(call for term in terms for call in term.calls),
        )

    def _compared(self, node: ast.Compare) -> _Term:
        left, right = self._term(node.left), self._term(node.comparators[0])
        sign, holds = _COMPARISONS[type(node.ops[0])]
        at = self._after(node.left, sign)
        if len(node.ops) > 1:
            at = self._after(node.comparators[0], _COMPARISONS[type(node.ops[1])][0])
            raise self._error(at, "one comparison at a time; join two with and")
        if left.type is not right.type:
            raise self._error(at, f"cannot compare {left.type.value} with {right.type.value}")
        if left.type is Type.BOOLEAN:
            raise self._error(at, "true and false cannot be compared; use and, or, not")
        if left.type is Type.TEXT and sign not in ("==", "!="):
            raise self._error(at, f"texts have no order; {sign!r} needs numbers")
        left, right = self._as_place(left, right), self._as_place(right, left)
        return _Term(
            at.column,
            Type.BOOLEAN,
            lambda facts: holds(left.value(facts), right.value(facts)),
            left.direction.compared(sign, right.direction),
            left.calls + right.calls,
        )

    def _as_place(self, term: _Term, other: _Term) -> _Term:
        """A text that is compared with a place names one."""
        text = term.text
        if text is None or not any(call.function.gives_place for call in other.calls):
            return term
        self.compared.append(Mention(Names.PLACE, text, term.column))
        return replace(term, value=lambda facts: facts.id_of(Names.PLACE, text))

    def _call(self, name: ast.Name, arguments: list[ast.expr] | tuple[()]) -> _Term:
        token = self._token(name)
        function = FUNCTIONS.get(token.text)
        if function is None:
            raise self._error(token, no_function(token.text))
        texts = [self._argument(function, node) for node in arguments]
        least = 0 if function.optional else len(function.parameters)
        if not least <= len(texts) <= len(function.parameters):
            raise self._error(token, f"write it as {function.signature}")
        mentions = tuple(
            Mention(kind, text.text, text.column)
            for kind, text in zip(function.parameters, texts, strict=False)
        )
        names = (text.text for text in texts)
        call = _Call(function, mentions, operator.methodcaller(function.name, *names))
        direction = Direction.RISING if function.rises else Direction.EITHER_WAY
        return _Term(token.column, function.result, call.value, direction, (call,))

    def _argument(self, function: Function, node: ast.expr) -> _Token:
        index = self._index(node.col_offset)
        opening = self._tokens[index - 1]
        if opening.text == "(" and self._tokens[index - 2].text != function.name:
            token = opening  # a text in parentheses of its own
        else:
            token = self._tokens[index]
        if token.kind != "text" or not isinstance(node, ast.Constant):
            raise self._error(token, f"{function.signature} takes texts in quotes, not {token}")
        return token

    def _boolean(self, term: _Term, what: str) -> _Term:
        if term.type is Type.BOOLEAN:
            return term
        reason = f"{what} must be true or false, and this is {term.type.value}"
        raise ExpressionError(self._source, term.column, reason)

    def _index(self, offset: int) -> int:
        return min(bisect_right(self._starts, offset) - 1, len(self._tokens) - 1)

    def _token(self, node: ast.expr) -> _Token:
        return self._tokens[self._index(node.col_offset)]

    def _after(self, node: ast.expr, text: str) -> _Token:
        """The first sign ``text`` after ``node``."""
        start = self._index((node.end_col_offset or 1) - 1) + 1
        following = islice(self._tokens, start, None)
        return next(t for t in following if t.kind == "sign" and t.text == text)

    def _error(self, where: _Token, reason: str) -> ExpressionError:
        return ExpressionError(self._source, where.column, reason)


def _expected_value(token: _Token) -> str:
    return f"expected a number, a text or a function, not {token}"


def _expected_end(token: _Token, *, in_call: bool = False) -> str:
    if in_call:
        return f"expected ',' between the arguments, not {token}"
    return f"did not expect {token} after a whole expression"
