"""Which sites are of one building, by alignments of pairs that are known."""

from dataclasses import replace

import numpy as np
import pytest

from projections.adapters.fleet.buildings import Buildings, comparable
from projections.localize.align.alignment import Alignment
from projections.localize.align.framed_things import FramedThings
from tests.unit.test_several_runs import FRAMES, POSES
from tests.unit.test_several_runs import pair as pair_of_runs

SITES = {name: number for number, name in enumerate("abcd")}


def site(space: str = "clip", count: int = 3) -> FramedThings:
    none = np.zeros((0, 2))
    ids = tuple(f"obj-{number}" for number in range(count))
    looks = np.ones((count, 4))
    owners = np.arange(count)
    kinds = np.array(["cup"] * count)
    square = np.zeros((count, 2, 2))
    xy = np.zeros((count, 2))
    return FramedThings(
        space, ids, kinds, xy, square, looks, xy[:, 0], owners, owners, 0.1, 0.5, POSES[0], none
    )


def pair(one: str, other: str, score: float = 100.0, second: float = 0.0) -> Alignment:
    return replace(pair_of_runs(SITES[one], SITES[other], score).found, second=second)


def test_what_is_surely_one_building_is_one_group() -> None:
    found = {("a", "c"): pair("a", "c"), ("b", "d"): pair("b", "d", 30.0), ("a", "b"): None}
    all_ = Buildings.of({name: site() for name in SITES}, found)
    assert {frame: [each.run for each in group] for frame, group in all_.groups.items()} == {
        "a": ["c"]
    }
    assert all_.groups["a"][0].transform == pytest.approx(FRAMES[2])
    assert all_.alone == ["b", "d"]
    assert [(one, other) for one, other, _ in all_.likely] == [("b", "d")]
    assert not all_.is_in_doubt
    document = all_.document()
    assert [each["sites"] for each in document["buildings"]] == [["a", "c"]]
    assert document["alone"][0] == {"site": "b", "nearest": "d", "common": 0, "score": 30.0}
    lines = all_.text().splitlines()
    assert lines[0].split()[:3] == ["building", "site", "things"]
    assert [line.split()[:2] for line in lines[1:5]] == [
        ["1", "a"],
        ["1", "c"],
        ["-", "b"],
        ["-", "d"],
    ]
    assert lines[5].startswith("perhaps one building: b and d: 0 common things, score 30")


def test_pairs_that_contradict_each_other_make_a_group_doubtful() -> None:
    wrong = pair_of_runs(0, 2, 90.0, (5.0, 0.0, 0.0)).found
    found = {("a", "b"): pair("a", "b"), ("b", "c"): pair("b", "c"), ("a", "c"): wrong}
    all_ = Buildings.of({name: site() for name in "abc"}, found)
    assert all_.is_in_doubt
    assert "in doubt: pairs contradict" in all_.text()
    assert "a and c contradict the other pairs: score 90 against 100" in all_.text()


def test_sites_without_anything_in_common_are_alone() -> None:
    all_ = Buildings.of({"a": site(), "b": site(count=0)}, {("a", "b"): None})
    assert all_.text() == (
        "building  site  things  most in common with\n"
        "-         a          3  none\n"
        "-         b          0  none\n"
    )


def test_only_embeddings_of_one_space_are_compared() -> None:
    things = {"a": site("siglip"), "b": site(), "c": site("siglip"), "d": site("siglip")}
    assert comparable(things) == ([("a", "c"), ("a", "d"), ("c", "d")], ["b"])
    assert comparable({}) == ([], [])
