"""Control characters of names are escaped in text and JSON output, and JSON keeps its value."""

import json
import unicodedata
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.base.text import visible, visible_json, visible_lines

BIDI = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
HOSTILE = st.text(
    st.sampled_from(
        "ab\x00\x07\x1b\n\r\t\x7f\x80\x9b\x9d\u061c\u200e\u202a\u202e\u2028\u2066\u2069é🪑"
    )
    | st.characters()
)


def control_characters(text: str) -> set[str]:
    """The characters that a terminal interprets instead of showing them, by Unicode's tables."""
    return {
        char
        for char in text
        if unicodedata.category(char) in ("Cc", "Zl", "Zp")
        or unicodedata.bidirectional(char) in BIDI
    }


@given(HOSTILE)
def test_no_control_character_is_left(text: str) -> None:
    assert control_characters(visible(text)) == set()
    assert control_characters(visible_lines(text)) <= {"\n"}
    assert visible_lines(text).count("\n") == text.count("\n")


@given(st.text(st.characters(categories=["L", "N", "P", "S", "Zs", "M"])))
def test_letters_of_any_script_are_not_escaped(text: str) -> None:
    assert visible(text) == text == visible_lines(text) == visible_json(text)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31m", r"\x1b[31m"),
        ("a\nb\tc", r"a\nb\tc"),
        ("\x9b2J", r"\x9b2J"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("Küche 🪑 مطبخ", "Küche 🪑 مطبخ"),
    ],
)
def test_escapes_are_readable(text: str, shown: str) -> None:
    assert visible(text) == shown


@given(st.dictionaries(HOSTILE, st.lists(HOSTILE | st.floats(allow_nan=False)), max_size=4))
@pytest.mark.parametrize("indent", [None, 2])
def test_json_keeps_its_value(indent: int | None, document: Any) -> None:
    text = visible_json(json.dumps(document, ensure_ascii=False, indent=indent))
    assert control_characters(text) <= {"\n"}
    assert json.loads(text) == document
