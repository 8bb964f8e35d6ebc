"""Which classes of a map a person means."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.ask.words import ClassMatch, classes_meant

CLASSES = (
    *("chair", "Office Chair", "coffee table", "dining table", "knife", "person", "bus", "battery"),
    *("potted_plant", "wine-glass", "couch", "Couch", "bookshelf", "17", "straße"),
)


@pytest.mark.parametrize(
    ("what", "match", "meant"),
    [
        ("chair", "exact", {"chair"}),
        ("CHAIR", "exact", {"chair"}),
        ("a chair", "exact", {"chair"}),
        ("the  coffee_table ", "exact", {"coffee table"}),
        ("couch", "exact", {"couch", "Couch"}),
        ("potted plant", "exact", {"potted_plant"}),
        ("STRASSE", "exact", {"straße"}),
        ("17", "exact", {"17"}),
        ("chairs", "plural", {"chair"}),
        ("the office chairs", "plural", {"Office Chair"}),
        ("couches", "plural", {"couch", "Couch"}),
        ("knives", "plural", {"knife"}),
        ("people", "plural", {"person"}),
        ("buses", "plural", {"bus"}),
        ("batteries", "plural", {"battery"}),
        ("wine glasses", "plural", {"wine-glass"}),
        ("bookshelves", "plural", {"bookshelf"}),
        ("table", "words", {"coffee table", "dining table"}),
        ("tables", "words", {"coffee table", "dining table"}),
        ("plants", "words", {"potted_plant"}),
        ("table dining", "words", {"dining table"}),
        ("chiar", "spelling", {"chair"}),
        ("coutch", "spelling", {"couch", "Couch"}),
        ("cofee tables", "spelling", {"coffee table"}),
        ("xyzzy", "spelling", set()),
        ("", "spelling", set()),
        ("the", "spelling", set()),
        (" _- ", "spelling", set()),
        ("18", "spelling", set()),
    ],
)
def test_a_class_is_meant_by_the_first_rule_that_finds_one(
    what: str, match: ClassMatch, meant: set[str]
) -> None:
    assert classes_meant(what, CLASSES) == (match, meant)


@given(what=st.text(max_size=8), classes=st.sets(st.text(max_size=8), max_size=6))
def test_any_text_means_some_of_the_classes_and_a_class_itself(
    what: str, classes: set[str]
) -> None:
    match, meant = classes_meant(what, classes)
    assert meant <= classes
    for name in classes:
        match, meant = classes_meant(name, classes)
        assert name in meant
        assert match == "exact"


def test_classes_are_those_of_the_first_rule_whatever_their_order() -> None:
    for what in ("tabel", "chairs", "coffe"):
        assert classes_meant(what, CLASSES) == classes_meant(what, reversed(CLASSES))
