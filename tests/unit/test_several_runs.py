"""Several runs in one frame, by pairs whose transforms are known."""

import math
from pathlib import Path

import numpy as np
import pytest

from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import CameraSettings, Settings
from projections.localize.align.alignment import Alignment
from projections.localize.align.framed_things import map_of_runs, maps_of_runs
from projections.localize.align.matching import Transform
from projections.localize.align.several import (
    Contradiction,
    PlacedRun,
    RunPair,
    _composed,
    _inverse,
    placed_runs,
)
from tests.support.logs import walk, write_log

FRAMES: list[Transform] = [(0.0, 0.0, 0.0), (4.0, -9.0, 2.5), (-20.0, 3.0, -1.0), (7.0, 7.0, 0.4)]
RUNS = [RunId(name) for name in "abcd"]
POSES = [np.array([(0.0, 0.0, 0.0), (8.0, 1.0, 0.5), (3.0, 6.0, 2.0)])] * 4


def pair(one: int, other: int, score: float = 100.0, off: Transform = (0.0, 0.0, 0.0)) -> RunPair:
    """The pair of two of the runs, its transform off by one before it."""
    true = _composed(_inverse(FRAMES[one]), FRAMES[other])
    information = np.diag((400.0, 400.0, 4000.0))
    found = Alignment(
        _composed(true, off), (), (), score, 0.0, 20, 20, 0.08, 0.02, 9.0, information
    )
    return RunPair(one, other, found)


def placed(*pairs: RunPair, count: int = 4) -> tuple[dict[RunId, PlacedRun], list[Contradiction]]:
    found, against = placed_runs(RUNS[:count], POSES[:count], pairs)
    return {each.run: each for each in found}, against


def test_all_runs_get_the_frame_of_the_first() -> None:
    """And with more pairs surer than by the pairs that lead there."""
    chain, _ = placed(pair(0, 1), pair(1, 2), pair(2, 3))
    every = [pair(i, j) for i in range(4) for j in range(i + 1, 4)]
    full, against = placed(*every)
    assert not against
    for found in (chain, full):
        assert list(found) == RUNS[1:]
        for number, each in enumerate(found.values(), start=1):
            assert each.frame == "a"
            assert each.verdict == "sure"
            assert each.transform == pytest.approx(FRAMES[number])
    assert full[RunId("d")].se_m < 0.6 * chain[RunId("d")].se_m


def test_errors_are_shared_by_a_circle_of_pairs() -> None:
    found, against = placed(pair(0, 1), pair(1, 2), pair(0, 2, off=(0.3, 0.0, 0.0)), count=3)
    assert not against
    apart = [math.dist(found[RUNS[n]].transform[:2], FRAMES[n][:2]) for n in (1, 2)]
    assert 0.05 < apart[0] < 0.15 < apart[1] < 0.25


def test_a_pair_that_contradicts_the_others_is_named() -> None:
    """Even if its score is the largest: the others agree with each other."""
    good = [pair(i, j) for i in range(4) for j in range(i + 1, 4) if (i, j) != (1, 2)]
    found, (against,) = placed(*good, pair(1, 2, 120.0, (5.0, 0.0, 0.0)))
    assert (against.one, against.other, against.score, against.against) == ("b", "c", 120.0, 200.0)
    assert str(against) == "b and c contradict the other pairs: score 120 against 200"
    for number, each in enumerate(found.values(), start=1):
        assert each.transform == pytest.approx(FRAMES[number])
        assert each.verdict == "likely"  # not sure: 120 is more than half of 200
    found, _ = placed(*good, pair(1, 2, 45.0, (5.0, 0.0, 0.0)))
    assert {each.verdict for each in found.values()} == {"sure"}


def test_of_three_pairs_that_contradict_none_is_taken() -> None:
    found, (against,) = placed(pair(0, 1), pair(1, 2), pair(0, 2, 90.0, (5.0, 0.0, 0.0)), count=3)
    assert (against.one, against.other) == ("a", "c")
    assert [each.verdict for each in found.values()] == ["unknown", "unknown"]
    assert "cannot tell" in str(found[RUNS[1]])


def test_runs_of_other_buildings_have_frames_of_their_own() -> None:
    found, _ = placed(pair(0, 2), pair(1, 3, 30.0))
    assert {run: (each.frame, each.verdict) for run, each in found.items()} == {
        "c": ("a", "sure"),
        "d": ("b", "likely"),
    }
    assert placed(count=2) == ({}, [])


def test_each_run_is_mapped_alone_by_one_pass(tmp_path: Path) -> None:
    """As by a fold of the log without the others."""
    runs = [RunId(name) for name in ("run-a", "run-b", "run-c")]
    documents = [walk(25, run_id=run, seed=number) for number, run in enumerate(runs)]
    path = write_log(
        tmp_path / "log", [each for keyframe in zip(*documents, strict=True) for each in keyframe]
    )
    settings = Settings(camera=CameraSettings(hfov_deg=69.4))
    with LogReader(path) as reader:
        end = reader.next_offset
        found = maps_of_runs(reader, end, NO_CORRECTIONS, settings, runs)
        for run in runs:
            others = set(runs) - {run}
            alone = map_of_runs(reader, end, NO_CORRECTIONS, settings, others)
            assert [each.keyframe_id for each in found[run].keyframes] == list(range(25))
            objects = [[str(o) for o in each.objects.values()] for each in (found[run], alone)]
            assert objects[0] == objects[1] != []
            seen = [[str(o) for o in each.observations] for each in (found[run], alone)]
            assert seen[0] == seen[1]
