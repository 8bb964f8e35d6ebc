"""Generating the trial data ``worlds`` that lies beside the repository, where it does."""

from types import ModuleType, SimpleNamespace

import pytest

from projections.fold.settings import CameraConstants, Settings
from scripts.programs.bench.truth.folding import fold_timed
from scripts.programs.bench.truth.worlds import NoWorldsError, load_generator, make_case, pairs
from tests.programs.truth_cases import trial_generator

NAMES = SimpleNamespace(
    DEVELOP=["w1", "w2", "w3"],
    VALIDATE=["v1"],
    PROFILES={"p": {"use": "develop"}, "q": {"use": "develop"}, "r": {"use": "validate"}},
)


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    return trial_generator()


def test_absent_data_is_named_with_the_way_to_give_it(tmp_path):
    with pytest.raises(NoWorldsError, match=r"make_worlds\.py is absent; give its folder by"):
        load_generator(tmp_path)


def test_pairs_are_those_of_the_half_or_those_named():
    assert len(pairs(NAMES, "develop")) == 6
    assert pairs(NAMES, "validate") == [("r", "v1")]
    assert pairs(NAMES, "develop", ["v1"], ["r"]) == [("r", "v1")]
    assert pairs(NAMES, "develop", quick=True) == [("p", "w1"), ("q", "w2"), ("p", "w3")]
    with pytest.raises(NoWorldsError, match="--world x: unknown; there are v1, w1, w2, w3"):
        pairs(NAMES, "develop", ["x"])
    with pytest.raises(NoWorldsError, match="--profile x: unknown; there are p, q, r"):
        pairs(NAMES, "develop", profiles=["x"])


def test_a_case_is_read_from_the_cache_as_it_was_made(generator, tmp_path):
    made = make_case(generator, "rover", "tb3_house", limit=40, cache=tmp_path)
    files = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    read = make_case(generator, "rover", "tb3_house", limit=40, cache=tmp_path)
    assert files == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert len(made.events) == len(read.events) == 120  # runs a, b, c
    runs = [accepted.envelope.run_id for accepted in read.events]
    assert runs == sorted(runs)
    assert runs[0] == read.first_run
    assert read.camera == CameraConstants(hfov_deg=69.4, width_px=640, height_px=400)
    assert read.looks_again == {}
    view, seconds = fold_timed(read.events, Settings())
    assert len(view.keyframes) == 120
    assert seconds > 0


@pytest.mark.slow
def test_moved_things_have_both_positions_and_looks_at_the_old_one(generator, tmp_path):
    case = make_case(generator, "rover", "aws_house", moved=0.5, limit=120, cache=tmp_path)
    moved = {name: thing for name, thing in case.things.items() if thing.moved_to is not None}
    assert moved
    assert case.looks_again.keys() == moved.keys()
    assert max(case.looks_again.values()) > 0
    for thing in moved.values():
        assert thing.moved_to != (thing.x, thing.y)
