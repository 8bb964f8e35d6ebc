"""A small recursive parser: the only way from text to something that is evaluated; no eval.

    either  = both ("or" both)*
    both    = no ("and" no)*
    no      = "not" no | compare
    compare = value (("<" | "<=" | "==" | "!=" | ">=" | ">") value)?
    value   = number | text | "none" | name [ "(" [text ("," text)*] ")" ] | "(" either ")"

A comparison needs two numbers or two texts, texts know only == and !=, and the whole must be a
truth. A function without arguments may be written without parentheses.
"""

import difflib

from .errors import ExpressionError
from .functions import FUNCTIONS, Function
from .syntax import Both, Call, Compare, Constant, Either, Node, Not
from .tokens import Token, TokenKind, tokenize
from .values import Type

MAX_DEPTH = 100
"""Nesting a person may write; it keeps the parser's own recursion bounded."""

_WORDS = ("and", "or", "not")
_COMPARISONS = ("<", "<=", "==", "!=", ">=", ">")


def parse(source: str) -> Node:
    """The expression ``source`` as a checked tree of type truth; raises ExpressionError."""
    return _Parser(source).whole()


class _Parser:
    """One pass over the tokens, one token ahead."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._tokens = list(tokenize(source))
        self._index = 0
        self._depth = 0

    def whole(self) -> Node:
        node = self._either()
        if self._now.kind != "end":
            raise self._error(self._now, f"did not expect {self._now} after a whole expression")
        return self._truth(node, "an expression")

    @property
    def _now(self) -> Token:
        return self._tokens[self._index]

    def _take(self) -> Token:
        token = self._now
        self._index += 1
        return token

    def _is(self, kind: TokenKind, *texts: str) -> bool:
        return self._now.kind == kind and self._now.text in texts

    def _expect(self, sign: str, after: str) -> None:
        if not self._is("sign", sign):
            raise self._error(self._now, f"expected {sign!r} {after}, not {self._now}")
        self._take()

    def _error(self, where: Token | Node, reason: str) -> ExpressionError:
        return ExpressionError(self._source, where.column, reason)

    def _deeper(self) -> None:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._error(self._now, f"nested more than {MAX_DEPTH} deep")

    def _truth(self, node: Node, what: str) -> Node:
        if node.type is Type.TRUTH:
            return node
        raise self._error(node, f"{what} must be true or false, and this is {node.type.value}")

    def _either(self) -> Node:
        left = self._both()
        while self._is("name", "or"):
            column = self._take().column
            right = self._both()
            left = Either(
                column, self._truth(left, "a side of or"), self._truth(right, "a side of or")
            )
        return left

    def _both(self) -> Node:
        left = self._no()
        while self._is("name", "and"):
            column = self._take().column
            right = self._no()
            left = Both(
                column, self._truth(left, "a side of and"), self._truth(right, "a side of and")
            )
        return left

    def _no(self) -> Node:
        if not self._is("name", "not"):
            return self._compare()
        column = self._take().column
        self._deeper()
        operand = self._no()
        self._depth -= 1
        return Not(column, self._truth(operand, "what stands after not"))

    def _compare(self) -> Node:
        left = self._value()
        if not self._is("sign", *_COMPARISONS):
            return left
        sign = self._take()
        right = self._value()
        if self._is("sign", *_COMPARISONS):
            raise self._error(self._now, "one comparison at a time; join two with and")
        self._check_comparison(sign, left, right)
        return Compare(sign.column, sign.text, left, right)

    def _check_comparison(self, sign: Token, left: Node, right: Node) -> None:
        if left.type is not right.type:
            raise self._error(sign, f"cannot compare {left.type.value} with {right.type.value}")
        if left.type is Type.TRUTH:
            raise self._error(sign, "truths are not compared; write and, or, not")
        if left.type is Type.TEXT and sign.text not in ("==", "!="):
            raise self._error(sign, f"texts have no order; {sign.text!r} needs numbers")

    def _value(self) -> Node:
        token = self._take()
        if token.kind == "number":
            return Constant(token.column, Type.NUMBER, int(token.text))
        if token.kind == "text":
            return Constant(token.column, Type.TEXT, token.text)
        if token.kind == "name" and token.text == "none":
            return Constant(token.column, Type.TEXT, None)
        if token.kind == "name" and token.text not in _WORDS:
            return self._call(token)
        if token.kind == "sign" and token.text == "(":
            return self._inner()
        raise self._error(token, f"expected a number, a text or a function, not {token}")

    def _inner(self) -> Node:
        self._deeper()
        node = self._either()
        self._depth -= 1
        self._expect(")", "to close the parenthesis")
        return node

    def _call(self, name: Token) -> Call:
        function = FUNCTIONS.get(name.text)
        if function is None:
            raise self._error(name, _no_function(name.text))
        arguments = self._arguments(function) if self._is("sign", "(") else ()
        least = 0 if function.optional else len(function.parameters)
        if not least <= len(arguments) <= len(function.parameters):
            raise self._error(name, f"write it as {function.signature}")
        return Call(name.column, function.result, function, arguments)

    def _arguments(self, function: Function) -> tuple[Constant, ...]:
        self._take()
        arguments: list[Constant] = []
        while not self._is("sign", ")"):
            if arguments:
                self._expect(",", f"between the arguments of {function.name}")
            arguments.append(self._argument(function))
        self._take()
        return tuple(arguments)

    def _argument(self, function: Function) -> Constant:
        token = self._take()
        if token.kind != "text":
            raise self._error(token, f"{function.signature} takes texts in quotes, not {token}")
        return Constant(token.column, Type.TEXT, token.text)


def _no_function(name: str) -> str:
    near = difflib.get_close_matches(name.lower(), FUNCTIONS, n=1)
    if near:
        return f"no function {name!r}; did you mean {near[0]!r}?"
    return f"no function {name!r}; there are {', '.join(sorted(FUNCTIONS))}"
