"""Conditions: evaluation, and errors with their columns."""

import ast
import inspect
import warnings
from dataclasses import dataclass, field
from typing import Any

import pytest

from projections.history.condition_functions import FUNCTIONS, Function, Names, functions_help
from projections.history.conditions import Expression, ExpressionError


@dataclass
class FakeFacts:
    """A map written out by hand: three keyframes, two places, one of them absorbed."""

    places: dict[str, str] = field(default_factory=lambda: {"a:1": "a_p0", "a:2": "a_p0"})

    def id_of(self, kind: Names, text: str) -> str:
        return text

    def place_count(self) -> int:
        return 2

    def noise_count(self) -> int:
        return 1

    def keyframe_count(self, run_id: str | None = None) -> int:
        return {None: 3, "a": 3}.get(run_id, 0)

    def object_count(self, class_name: str | None = None) -> int:
        return {None: 5, "chair": 2}.get(class_name, 0)

    def place_of(self, keyframe: str) -> str | None:
        return self.places.get(keyframe)

    def same_place(self, a: str, b: str) -> bool:
        place = self.place_of(a)
        return place is not None and place == self.place_of(b)

    def located_in(self, object_id: str) -> str | None:
        return "a_p0" if object_id == "obj-1" else None

    def sightings(self, object_id: str) -> int:
        return 4 if object_id == "obj-1" else 0

    def size(self, place_id: str) -> int:
        return 2 if place_id == "a_p0" else 0

    def transitions(self, a: str, b: str) -> int:
        return 7 if {a, b} == {"a_p0", "a_p2"} else 0

    def merged(self, place_id: str) -> bool:
        return place_id == "a_p1"


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_the_method_of_a_function_takes_its_arguments(function: Function) -> None:
    _, *taken = inspect.signature(function.method).parameters.values()
    assert len(taken) == len(function.parameters)
    assert all((each.default is None) is function.optional for each in taken)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("place_count < 3", True),
        ("place_count() < 2", False),
        ("noise_count == 1 and keyframe_count >= 3", True),
        ("keyframe_count('a') == keyframe_count", True),
        ("keyframe_count('b') == 0", True),
        ("object_count('chair') > 1", True),
        ("object_count > 5", False),
        ("same_place('a:1', 'a:2')", True),
        ("same_place('a:1', 'a:3')", False),
        ("same_place('a:3', 'a:3')", False),  # noise is in no place, not even with itself
        ("not same_place('a:1', 'a:3')", True),
        ("located_in('obj-1') == 'a_p0'", True),
        ("located_in('obj-2') == none", True),
        ("place_of('a:1') != place_of('a:3')", True),
        ("transitions('a_p2', 'a_p0') == 7", True),
        ("merged('a_p1') and not merged('a_p0')", True),
        ("size('a_p0') == 2 and sightings('obj-1') == 4", True),
        ("1 < 0 or 2 > 1 and 1 > 2", False),  # and binds tighter than or
        ("(1 < 2 or 2 > 1) and 1 > 2", False),
        ("1 < 2 or (2 > 1 and 1 > 2)", True),
        ("not 1 > 2 and 1 < 2", True),  # not binds tighter than and
        ("place_count > -1", True),
    ],
)
def test_expressions_hold(text: str, holds: bool) -> None:
    assert Expression(text).holds(FakeFacts()) is holds


@pytest.mark.parametrize(
    ("text", "column", "says"),
    [
        ("", 1, "invalid syntax; compare by"),
        ("place_count <", 14, "invalid syntax"),
        ("place_count < 3 and placecount > 2", 21, "did you mean 'place_count'?"),
        ("wibble > 1", 1, "there are keyframe_count, located_in"),
        ("place_count = 3", 13, "invalid syntax; compare by < <= =="),
        ("place_count < 'three'", 15, "cannot compare a number with a text or none"),
        ("place_of('a:1') < 'a_p0'", 19, "texts have no order"),
        ("place_count", 1, "must be true or false, and this is a number"),
        ("place_count and 1 < 2", 1, "an operand of and"),
        ("1 < 2 or 'x'", 10, "an operand of or"),
        ("not place_count", 5, "the operand of not"),
        ("1 < 2 < 3", 9, "one comparison at a time"),
        ("place_count() + 1 > 3", 1, "a condition does no arithmetic, it only compares"),
        ("1 in 3", 1, "expected a number, a text in quotes or a function"),
        ("True", 1, "expected a number, a text in quotes or a function"),
        ("1 < -True", 5, "expected a number, a text in quotes or a function"),
        ("merged(place='a_p0')", 1, "expected a number, a text in quotes or a function"),
        ("(1 < 2", 1, "was never closed"),
        ("1 < 2)", 6, "unmatched ')'"),
        ("same_place('a:1')", 1, "write it as same_place(keyframe, keyframe)"),
        ("object_count(chair) > 1", 14, "takes texts in quotes"),
        ("merged('a_p0", 8, "unterminated string"),
        ("merged('\u00e4') or merged('a\\d')", 23, "invalid escape sequence"),
        ("  merged('\u00e4') or\t3.5 > 1", 18, "numbers are whole"),
        ("place_count < 3 && 1 < 2", 18, "join by and, or, not"),
        ("(1 < 2) == (2 < 3)", 13, "true and false cannot be compared"),
        ("__import__('os') == 'x'", 1, "no function '__import__'"),
        ("place_count < 3; 1", 16, "invalid syntax"),
        ("merged('a\0')", 13, "null bytes"),
        ("merged('a\udc80')", 1, "surrogates not allowed"),
        (" or ".join(["place_count"] * 300), 4_000, "more than 4,000 characters"),
    ],
)
def test_an_error_points_at_its_column(text: str, column: int, says: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        Expression(text)
    assert says in str(caught.value)
    assert caught.value.column == column
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)


def test_the_pointer_stands_under_the_column() -> None:
    with pytest.raises(ExpressionError) as caught:
        Expression("place_count < 3 and wrong > 2")
    source, caret = caught.value.pointer.splitlines()
    assert source[caret.index("^") :].startswith("wrong")


def test_deep_nesting_is_an_error_and_no_overflow() -> None:
    assert Expression("(" * 90 + "1 < 2" + ")" * 90).holds(FakeFacts())
    for text in ("(" * 1_500 + "1 < 2", "not " * 500 + "1 < 2", "-" * 3_000 + "1 < 2"):
        with pytest.raises(ExpressionError, match="nested"):
            Expression(text)


def test_ids_may_hold_quotes_and_backslashes() -> None:
    facts = FakeFacts({r"it's:1": "p", 'b"\\s:1': "p"})
    assert Expression(r"""same_place('it\'s:1', "b\"\\s:1")""").holds(facts)


def test_mentions_and_readings() -> None:
    expression = Expression("same_place('a:1', 'a:3') or object_count('chair') > 9")
    assert [(m.kind.value, m.text, m.column) for m in expression.mentions()] == [
        ("keyframe", "a:1", 12),
        ("keyframe", "a:3", 19),
        ("class", "chair", 42),
    ]
    assert expression.readings(FakeFacts()) == (
        ("same_place('a:1', 'a:3')", False),
        ("object_count('chair')", 2),
    )


def test_the_help_lists_every_function() -> None:
    listed = functions_help().splitlines()
    assert [line.split("(")[0] for line in listed] == list(FUNCTIONS)


def test_what_other_threads_are_warned_of_meanwhile_is_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parse = ast.parse

    def warned(*args: Any, **more: Any) -> Any:
        warnings.warn("of another thread", DeprecationWarning, stacklevel=1)
        return parse(*args, **more)

    monkeypatch.setattr(ast, "parse", warned)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        assert Expression("place_count() > 1")
    assert [str(each.message) for each in heard] == ["of another thread"]
