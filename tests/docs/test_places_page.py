"""The picture in docs/places.md is what the code draws today."""

from tests.docs.places_picture import PICTURE, drawn


def test_the_picture_of_a_merge_is_what_the_reducer_knows() -> None:
    told = "draw it again: python -m tests.docs.places_picture"
    assert PICTURE.read_text("utf-8") == drawn(), told


def test_the_page_shows_it() -> None:
    assert "images/place-merge.svg" in (PICTURE.parents[1] / "places.md").read_text("utf-8")
