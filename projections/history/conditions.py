"""Parser of conditions over the map, as ``bisect`` takes: ``place_count < 3 and not merged('p0')``.

A condition is a subset of a Python expression: ``and``, ``or``, ``not``, one comparison at a time,
whole numbers, quoted texts, ``none`` and the functions of `condition_functions`; a function without
arguments may be written without parentheses. The standard library's `ast` parses it, and only the
node types named here are accepted; nothing is compiled or evaluated as code. Types are checked
when parsing: a comparison needs two numbers or two texts, texts have only == and !=, and the whole
must be true or false. Each error names its column.
"""

import ast
import functools
import operator
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from eventsrc.base.errors import MisuseError

from . import condition_functions as functions

MAX_DEPTH = 100
"""Greatest depth of ``not``, ``and``, ``or`` and comparisons; it bounds the recursion here."""
MAX_CHARACTERS = 4_000
"""A condition is evaluated for each event of a scan."""

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
    function: functions.Function
    mentions: tuple[functions.Mention, ...]
    value: Callable[[functions.HistoryFacts], functions.Value]

    def __str__(self) -> str:
        arguments = ", ".join(repr(mention.text) for mention in self.mentions)
        return f"{self.function.name}({arguments})" if arguments else self.function.name


@dataclass(frozen=True, slots=True)
class _Term:
    """A part of a condition with its type, and the function of a map that gives its value."""

    column: int
    type: functions.Type
    value: Callable[[functions.HistoryFacts], functions.Value]
    direction: functions.Direction = functions.Direction.STEADY
    calls: tuple[_Call, ...] = ()
    text: str | None = None  # of one in quotes


class Expression:
    """A condition over the map, parsed once. Raises ExpressionError for a text that is none."""

    def __init__(self, source: str) -> None:
        self.source = source
        parser = _Parser(source)
        self._term = parser.parse()
        self._compared = tuple(parser.compared)

    def __str__(self) -> str:
        return self.source

    def holds(self, facts: functions.HistoryFacts) -> bool:
        """Whether it is true of this map."""
        return bool(self._term.value(facts))

    def readings(self, facts: functions.HistoryFacts) -> tuple[tuple[str, functions.Value], ...]:
        """Every function call as written, with its value."""
        return tuple({str(call): call.value(facts) for call in self._term.calls}.items())

    @property
    def direction(self) -> functions.Direction:
        """How its truth can change as events are added."""
        return self._term.direction

    def mentions(self) -> tuple[functions.Mention, ...]:
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
        self._lines = source.lstrip().splitlines(keepends=True)
        self._skipped = len(source) - len(source.lstrip())
        self.compared: list[functions.Mention] = []
        """Texts that are compared with a place."""

    def parse(self) -> _Term:
        if len(self._source) > MAX_CHARACTERS:
            raise self._error(MAX_CHARACTERS, f"more than {MAX_CHARACTERS:,} characters")
        try:
            with warnings.catch_warnings():
                # Of a backslash that escapes nothing, and of 1or; not those of other threads.
                warnings.filterwarnings("error", r".*\binvalid .*(sequence|literal)")
                tree = ast.parse(self._source.strip(), mode="eval")
        except SyntaxError as error:
            at = len(self._source) + 1
            if error.lineno and error.offset:
                at = self._column(error.lineno, 0) + error.offset - 1
            reason = f"{error.msg}; compare by < <= == != >= >, join by and, or, not"
            raise self._error(at, reason) from None
        except (RecursionError, MemoryError):
            raise self._error(1, f"nested more than {MAX_DEPTH} deep") from None
        except ValueError as error:
            raise self._error(1, str(error)) from None
        return self._boolean(self._term(tree.body, 0), "an expression")

    def _term(self, node: ast.expr, depth: int) -> _Term:
        column = self._column(node.lineno, node.col_offset)
        if depth > MAX_DEPTH:
            raise self._error(column, f"nested more than {MAX_DEPTH} deep")
        match node:
            case ast.Constant(value=str() as text):
                return _Term(column, functions.Type.TEXT, lambda _: text, text=text)
            case ast.Constant(value=int() as number) if type(number) is int:
                return _Term(column, functions.Type.NUMBER, lambda _: number)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as number)) if (
                type(number) is int
            ):
                return _Term(column, functions.Type.NUMBER, lambda _: -number)
            case ast.Name(id="none"):
                return _Term(column, functions.Type.TEXT, lambda _: None)
            case ast.Name(id=name):
                return self._call(name, column, [])
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, column, arguments)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                inner = self._boolean(self._term(operand, depth + 1), "the operand of not")
                return _Term(
                    column,
                    functions.Type.BOOLEAN,
                    lambda facts: not inner.value(facts),
                    inner.direction.opposite,
                    inner.calls,
                )
            case ast.BoolOp(op=op, values=values):
                word = "and" if isinstance(op, ast.And) else "or"
                terms = [self._term(value, depth + 1) for value in values]
                return self._joined(column, word, terms)
            case ast.Compare(ops=[op], left=left, comparators=[right]) if type(op) in _COMPARISONS:
                both = self._term(left, depth + 1), self._term(right, depth + 1)
                return self._comparison(*both, *_COMPARISONS[type(op)])
            case ast.Compare(ops=[_, _, *_], comparators=[_, second, *_]):
                column = self._column(second.lineno, second.col_offset)
                raise self._error(column, "one comparison at a time; join two with and")
            case ast.BinOp():
                raise self._error(column, "a condition does no arithmetic, it only compares")
            case ast.Constant(value=float()):
                raise self._error(column, "numbers are whole")
            case _:
                raise self._error(column, "expected a number, a text in quotes or a function")

    def _joined(self, column: int, word: str, terms: list[_Term]) -> _Term:
        for term in terms:
            self._boolean(term, f"an operand of {word}")
        join = all if word == "and" else any
        return _Term(
            column,
            functions.Type.BOOLEAN,
            lambda facts: join(term.value(facts) for term in terms),
            functools.reduce(functions.Direction.joined, (term.direction for term in terms)),
            tuple(call for term in terms for call in term.calls),
        )

    def _comparison(
        self, left: _Term, right: _Term, sign: str, holds: Callable[[Any, Any], bool]
    ) -> _Term:
        at = right.column
        if left.type is not right.type:
            raise self._error(at, f"cannot compare {left.type.value} with {right.type.value}")
        if left.type is functions.Type.BOOLEAN:
            raise self._error(at, "true and false cannot be compared; use and, or, not")
        if left.type is functions.Type.TEXT and sign not in ("==", "!="):
            raise self._error(at, f"texts have no order; {sign!r} needs numbers")
        left, right = self._as_place(left, right), self._as_place(right, left)
        return _Term(
            left.column,
            functions.Type.BOOLEAN,
            lambda facts: holds(left.value(facts), right.value(facts)),
            left.direction.compared(sign, right.direction),
            left.calls + right.calls,
        )

    def _as_place(self, term: _Term, other: _Term) -> _Term:
        """A text that is compared with a place names one."""
        text = term.text
        if text is None or not any(call.function.gives_place for call in other.calls):
            return term
        self.compared.append(functions.Mention(functions.Names.PLACE, text, term.column))
        return replace(term, value=lambda facts: facts.id_of(functions.Names.PLACE, text))

    def _call(self, name: str, column: int, arguments: list[ast.expr]) -> _Term:
        function = functions.FUNCTIONS.get(name)
        if function is None:
            raise self._error(column, functions.no_function(name))
        texts = [self._argument(function, node) for node in arguments]
        least = 0 if function.optional else len(function.parameters)
        if not least <= len(texts) <= len(function.parameters):
            raise self._error(column, f"write it as {function.signature}")
        mentions = tuple(
            functions.Mention(kind, *text)
            for kind, text in zip(function.parameters, texts, strict=False)
        )
        names = (text for text, _ in texts)
        call = _Call(function, mentions, operator.methodcaller(function.name, *names))
        direction = functions.Direction.RISING if function.rises else functions.Direction.EITHER_WAY
        return _Term(column, function.result, call.value, direction, (call,))

    def _argument(self, function: functions.Function, node: ast.expr) -> tuple[str, int]:
        """The text and its column."""
        column = self._column(node.lineno, node.col_offset)
        if not (isinstance(node, ast.Constant) and isinstance(node.value, str)):
            raise self._error(column, f"{function.signature} takes texts in quotes")
        return node.value, column

    def _boolean(self, term: _Term, what: str) -> _Term:
        if term.type is functions.Type.BOOLEAN:
            return term
        reason = f"{what} must be true or false, and this is {term.type.value}"
        raise self._error(term.column, reason)

    def _column(self, line: int, offset: int) -> int:
        """The column in the condition of a byte of a line of what was parsed."""
        before = sum(map(len, self._lines[: line - 1]))
        text = self._lines[line - 1] if line <= len(self._lines) else ""
        return self._skipped + before + len(text.encode()[:offset].decode()) + 1

    def _error(self, column: int, reason: str) -> ExpressionError:
        return ExpressionError(self._source, min(column, len(self._source) + 1), reason)
