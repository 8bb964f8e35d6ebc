"""What a text means among places and objects: the rules, one after another, by a slow oracle."""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from projections.fold.place_types import NAMES
from projections.map.naming import (
    MOST_LISTED,
    Existence,
    Kind,
    NoSuchThing,
    Rule,
    SeveralThings,
    ShortIds,
    Thing,
    Things,
    matches,
    thing_called,
)

WORDS = ["kitchen", "Kitchen", "KITCHEN", "cup", "Cup", "straße", "STRASSE", "İ", "hall", "lounge"]
HEX = ["1a2b3c", "1a2b3d", "1a2b3c4d", "facade", "000000"]
RUNS = ["a", "b", "a_p1", "obj-1a2b3c", "p3", "x y", "p"]
HOSTILE = ["", " ", "p", "_p3", "obj-", "obj-1a2b3", "\x1b[2J", "\ud800", ".*", "p03", "P3", "p3\n"]
place_ids = st.tuples(st.sampled_from(RUNS), st.integers(0, 3)).map(lambda p: f"{p[0]}_p{p[1]}")
object_ids = st.tuples(st.sampled_from(HEX), st.integers(0, 2)).map(
    lambda p: "obj-" + p[0].ljust(15, "0") + str(p[1])
)
names = st.none() | st.sampled_from([*WORDS, "p1", "p3", "1a2b3c", "obj-1a2b3c"]) | place_ids
existences = st.sampled_from(Existence)
types = st.none() | st.sampled_from(sorted(set(NAMES.values())))
maps = st.tuples(
    st.lists(st.tuples(place_ids, types, names, existences), max_size=6, unique_by=lambda t: t[0]),
    st.lists(
        st.tuples(object_ids, st.sampled_from([*WORDS, "p3", "1a2b3c"]), existences),
        max_size=6,
        unique_by=lambda t: t[0],
    ),
).map(
    lambda both: [
        *(Thing("place", n, i, t, name, s) for n, (i, t, name, s) in enumerate(both[0])),
        *(Thing("object", n, i, c, existence=s) for n, (i, c, s) in enumerate(both[1])),
    ]
)
texts = st.one_of(
    place_ids, object_ids, st.sampled_from(WORDS + HEX + HOSTILE + ["p0", "p1", "p2", "p3"]),
    object_ids.map(lambda i: i[4:12]), object_ids.map(lambda i: i[:11]), st.text(max_size=4),
)  # fmt: skip
kinds = st.sampled_from([("place",), ("object",), ("place", "object")])


def oracle(text: str, things: list[Thing]) -> list[Thing]:
    """Each rule of the module's docstring, in the order given there."""
    standing = [t for t in things if t.stands]
    hexadecimal = text.removeprefix("obj-")

    def short(thing: Thing) -> bool:
        if thing.kind == "place":
            number = thing.id[len(thing.id.rpartition("_")[0]) + 1 :]
            return number == text
        digits = set(hexadecimal) <= set("0123456789abcdef") and len(hexadecimal) >= 6
        return digits and thing.id[4:][: len(hexadecimal)] == hexadecimal

    def of_type(thing: Thing) -> bool:
        wanted = {text.casefold(), NAMES.get(text.casefold())}
        return thing.kind == "place" and thing.word is not None and thing.word in wanted

    objects = [t for t in standing if t.kind == "object"]
    tried = [
        [t for t in things if t.id == text],
        [t for t in standing if t.name == text],
        [t for t in standing if t.name is not None and t.name.casefold() == text.casefold()],
        [t for t in standing if short(t)],
        [t for t in things if short(t) and t.existence is Existence.MERGED],
        [t for t in things if short(t)],
        [t for t in standing if of_type(t)],
        [t for t in objects if t.word == text],
        [t for t in objects if (t.word or "").casefold() == text.casefold()],
    ]
    return next((found for found in tried if found), [])


@given(maps, texts, kinds)
def test_a_text_means_what_the_rules_say(
    things: list[Thing], text: str, of: tuple[Kind, ...]
) -> None:
    expected = oracle(text, [t for t in things if t.kind in of])
    event(f"{min(len(expected), 2)} found")
    if len(expected) == 1:
        assert thing_called(text, things, of) is expected[0]
        return
    with pytest.raises(SeveralThings if expected else NoSuchThing) as caught:
        thing_called(text, things, of)
    assert repr(text) in str(caught.value)
    assert all(thing.id in str(caught.value) for thing in expected)


@given(maps, texts)
def test_likely_things_are_all_that_a_text_may_mean(things: list[Thing], text: str) -> None:
    assert matches(text, Things(things).likely(text)) == matches(text, things)


@given(maps)
def test_no_name_hides_an_id(things: list[Thing]) -> None:
    for thing in things:
        assert matches(thing.id, things) == (Rule.ID, [thing])


@given(maps)
def test_a_short_id_means_its_thing_and_no_shorter_one_does(things: list[Thing]) -> None:
    short = ShortIds.of(things)
    assert len({short(thing.id) for thing in things}) == len(things)
    for thing in things:
        printed = short(thing.id)
        assert thing_called(printed, things, ("place", "object")) is thing
        if printed == thing.id:
            continue
        for shorter in (printed[:end] for end in range(10, len(printed))):
            alike = [t for t in things if t.kind == "object" and t.id.startswith(shorter)]
            assert len(alike) > 1
    assert short("elsewhere_p9") == "elsewhere_p9"


@given(maps, st.lists(st.integers(0, 11), max_size=5), st.sampled_from([" ", ", ", " – ", " ("]))
def test_what_a_text_names_by_short_ids_are_the_same_things(
    things: list[Thing], numbers: list[int], between: str
) -> None:
    """Each short id in a text is found where the whole id was, and means its thing."""
    named = [things[number % len(things)] for number in numbers] if things else []
    short = ShortIds.of(things)
    text = short.text(between.join(f"{thing.id}: {thing.word}" for thing in named))
    words = [f"{short(thing.id)}: {thing.word}" for thing in named]
    assert text == between.join(words)
    assert short.text(text) == text
    for thing, word in zip(named, words, strict=True):
        printed = word.removesuffix(f": {thing.word}")
        assert thing_called(printed, things, ("place", "object")) is thing


def test_ids_inside_other_words_stay_whole() -> None:
    things = [Thing("place", 0, "a_p0"), Thing("object", 0, "obj-1a2b3c0000000000")]
    text = ShortIds.of(things).text
    for word in (
        "a_p0:12", "a_p0_kf1_d0", "logs/a_p0", "a_p0.png", "a_p0/events", "b-a_p0", '"a_p0"',
        "a_p01", "a_p0-b", "obj-1a2b3c0000000001", "x-obj-1a2b3c0000000000", "_p0", "a_p1",
    ):  # fmt: skip
        assert text(f"see {word} there") == f"see {word} there"
    assert text("a_p0, (a_p0) a_p0: 'a_p0'.") == "p0, (p0) p0: 'p0'."
    assert text("obj-1a2b3c0000000000 cup: a_p0 → a_p1") == "obj-1a2b3c cup: p0 → a_p1"


def test_an_error_lists_ten_and_counts_the_others() -> None:
    cups = [
        Thing("object", n, f"obj-{n:016x}", "cup", count=n + 1, spot=(1.0, n), place="a_p0")
        for n in range(13)
    ]
    with pytest.raises(SeveralThings) as caught:
        thing_called("Cup", cups, ("object",))
    said = str(caught.value)
    first, *listed, last = said.split("\n")
    assert first == "'Cup' means 13 objects; give the id of one:"
    assert listed[0] == "  obj-0000000000000000 (cup, in a_p0, seen 1 time at (1.00, 0.00))"
    assert len(listed) == MOST_LISTED
    assert last == "  and 3 more"


def test_an_error_names_what_is_spelled_alike_and_what_lists_all() -> None:
    things = [
        Thing("place", 0, "a_p0", "kitchen", "Anna's"),
        Thing("object", 0, "obj-1a2b3c0000000000", "umbrella stand"),
    ]
    with pytest.raises(NoSuchThing, match="near it: kitchen; `mapfold state` lists them"):
        thing_called("kitchn", things, ("place",))
    with pytest.raises(NoSuchThing, match=r"near it: umbrella stand; `mapfold state --json`"):
        thing_called("umbrela stand", things, ("object",))
    with pytest.raises(NoSuchThing, match=r"no object 'obj-1a2b4c' .*near it: obj-1a2b3c"):
        thing_called("obj-1a2b4c", things, ("place", "object"))
    hostile = Thing("place", 0, "a_p0", None, "kit\u202echen\x1b")
    with pytest.raises(NoSuchThing) as caught:
        thing_called("kit-chen", [hostile], ("place",))
    assert "\x1b" not in str(caught.value)
