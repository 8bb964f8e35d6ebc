"""Conditions evaluate as the Python expressions they are; any text is parsed or an error."""

from hypothesis import given
from hypothesis import strategies as st

from projections.history.conditions import Expression, ExpressionError
from tests.unit.test_conditions import FakeFacts

numbers = st.one_of(
    st.integers(-9, 9).map(str),
    st.sampled_from(["place_count()", "noise_count()", "object_count('chair')"]),
)
texts = st.sampled_from(["'a_p0'", "'x'", "None", "place_of('a:1')", "located_in('obj-2')"])
comparisons = st.one_of(
    st.tuples(numbers, st.sampled_from(["<", "<=", "==", "!=", ">=", ">"]), numbers),
    st.tuples(texts, st.sampled_from(["==", "!="]), texts),
).map(" ".join)
truths = st.recursive(
    st.one_of(comparisons, st.just("merged('a_p1')")),
    lambda inner: st.one_of(
        inner.map("({})".format),
        inner.map("not {}".format),
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(" ".join),
    ),
    max_leaves=12,
)


@given(truths)
def test_a_condition_equals_pythons_eval(text: str) -> None:
    facts = FakeFacts()
    names = {
        name: getattr(facts, name)
        for name in ("place_count", "noise_count", "object_count", "place_of", "located_in")
    }
    expected = eval(text, {"__builtins__": {}, "merged": facts.merged, **names})
    assert Expression(text.replace("None", "none")).holds(facts) is bool(expected)


@given(st.text(alphabet="place_count()<=>!'\"\\ andortx019,.;\n", max_size=60))
def test_any_text_is_parsed_or_an_error_at_a_column(text: str) -> None:
    column = _column_of_refusal(text)
    assert column is None or 1 <= column <= len(text) + 1


def _column_of_refusal(text: str) -> int | None:
    try:
        Expression(text)
    except ExpressionError as error:
        return error.column
    return None
