"""A place's likely type: known answers, the table's shape, names that decide."""

import math
import random
import re
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.adapters.sim.house import FURNITURE, MODELS
from projections.fold.place_types import (
    _ROOMS,
    NAMES,
    SHARES,
    SYNONYMS,
    TABLE,
    TYPES,
    UNSURE,
    known_class,
    place_type,
    type_of_name,
)


def type_of(counts: Mapping[str, float], name: str | None = None) -> str | None:
    found = place_type(counts, name)
    return None if found is None else found.type


@pytest.mark.parametrize(
    ("counts", "kind"),
    [
        ({"refrigerator": 1, "sink": 1, "microwave": 1, "chair": 2}, "kitchen"),
        ({"toilet": 1, "sink": 1}, "bathroom"),
        ({"bed": 1, "wardrobe": 1, "lamp": 2}, "bedroom"),
        ({"couch": 1, "tv": 1, "coffee table": 1}, "living room"),
        ({"desk": 4, "monitor": 3, "office chair": 4}, "office"),
        ({"dining table": 1, "chair": 4, "vase": 1}, "dining room"),
        ({"Fridge": 1, "night_stand": 0, "Cooker": 1}, "kitchen"),
        ({"washing machine": 1, "clothes dryer": 1}, "laundry room"),
        ({"pallet": 3, "forklift": 1, "box": 9}, "storage room"),
        ({"hospital bed": 1, "iv stand": 1, "curtain": 2}, "patient room"),
        ({"chair": 3}, None),
        ({"picture": 2, "lamp": 1}, None),
    ],
)
def test_known_rooms(counts: Mapping[str, float], kind: str | None) -> None:
    assert type_of(counts) == kind


@pytest.mark.parametrize("room", [name for name in FURNITURE if type_of_name(name) is not None])
def test_the_rooms_of_the_simulated_house(room: str) -> None:
    """By what stands in them; the dining room has its table and chairs besides."""
    counts: dict[str, float] = {"dining table": 1, "chair": 4} if room == "dining room" else {}
    for model in FURNITURE[room]:
        name = MODELS[model].class_name
        counts[name] = counts.get(name, 0) + 1
    assert type_of(counts) == type_of_name(room)


def test_unknown_classes_give_no_type() -> None:
    assert place_type({}) is None
    assert place_type({"gadget": 3, "": 1}) is None
    assert place_type({"toilet": 0.0}) is None


def test_an_object_seen_once_tells_little() -> None:
    once, often = place_type({"toilet": 0.25}), place_type({"toilet": 1.0})
    assert once is not None
    assert often is not None
    assert once.type is None
    assert often.candidates[0][0] == once.candidates[0][0] == "bathroom"
    assert often.probability > once.probability


def test_six_chairs_tell_little_more_than_three() -> None:
    few, many = place_type({"conference table": 1, "chair": 3}), place_type({"chair": 6})
    assert few is not None
    assert many is not None
    assert many.type is None


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("kitchen", "kitchen"),
        ("Kitchen 2", "kitchen"),
        ("KITCHEN/DINING", "kitchen"),
        ("dining hall", "dining room"),
        ("west office", "office"),
        ("offices", "office"),
        ("Toilets (2nd floor)", "bathroom"),
        ("guest-room", "bedroom"),
        ("lobby", "reception"),
        ("Anna", None),
        ("hallmark", None),
        ("", None),
        ("☕", None),
    ],
)
def test_a_name_that_says_a_type_decides(name: str, kind: str | None) -> None:
    assert type_of_name(name) == kind
    found = place_type({"toilet": 2, "bathtub": 1}, name)
    assert found is not None
    if kind is None:
        assert (found.type, found.named) == ("bathroom", False)
    else:
        assert (found.type, found.probability, found.named) == (kind, 1.0, True)
        assert place_type({}, name) == found


def test_the_table_is_whole() -> None:
    assert len(TABLE) > 100
    assert all(len(shares) == len(TYPES) and {*shares} <= {*SHARES} for shares in TABLE.values())
    for room in _ROOMS.strip().split("\n\n"):
        named = re.split(r", |\n\d+ % ", " ".join(room.split("\n  ")).partition("\n")[2])
        assert len(named) == len(set(named)), "a class has one grade"
    assert all(len({*shares}) > 1 for shares in TABLE.values()), "an uninformative row"
    assert {*SYNONYMS.values()} <= TABLE.keys()
    assert not SYNONYMS.keys() & TABLE.keys()
    assert {*NAMES.values()} == {*TYPES}
    for column, kind in enumerate(TYPES):
        assert any(shares[column] >= 0.5 for shares in TABLE.values()), kind


CLASSES = st.dictionaries(
    st.sampled_from([*sorted(TABLE), *sorted(SYNONYMS), "gadget"]),
    st.floats(0.0, 1e4) | st.integers(0, 9),
    max_size=12,
)


@given(CLASSES, st.randoms())
def test_probabilities_add_up_and_no_order_matters(
    counts: dict[str, float], chance: random.Random
) -> None:
    found = place_type(counts)
    shuffled = list(counts.items())
    chance.shuffle(shuffled)
    assert place_type(dict(shuffled)) == found
    if found is None:
        assert not any(count > 0 and known_class(name) for name, count in counts.items())
        return
    assert (found.type is None) == (found.probability < UNSURE)
    assert sum(p for _, p in found.candidates) <= 1.002
    assert [p for _, p in found.candidates] == sorted(
        (p for _, p in found.candidates), reverse=True
    )
    if found.type is not None:
        assert found.candidates[0] == (found.type, found.probability)


@given(CLASSES)
def test_the_answer_is_that_of_bayes_written_out(counts: dict[str, float]) -> None:
    found = place_type(counts)
    known: dict[str, float] = {}
    for name, count in counts.items():
        table_name = known_class(name)
        if table_name is not None and count > 0:
            known[table_name] = known.get(table_name, 0.0) + count
    if found is None:
        return
    weights = {name: min(n, math.sqrt(n)) for name, n in known.items()}
    temper = 0.6 if sum(weights.values()) <= 4.0 else 0.6 * 4.0 / sum(weights.values())
    likelihood = [
        sum(temper * weight * math.log(TABLE[name][column]) for name, weight in weights.items())
        for column in range(len(TYPES))
    ]
    most = max(likelihood)
    odds = [math.exp(each - most) for each in likelihood]
    assert found.probability == pytest.approx(max(odds) / sum(odds), abs=0.002)
