"""Candidates of the databases beside those of exact search, for tests."""

from pathlib import Path

import pytest

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.localize.relocalize import Candidates
from projections.map.fold import fold_log
from projections.map.log_commands import read_corrections
from projections.map.view import MapView


def found(candidates: Candidates) -> list[list[tuple[object, ...]]]:
    """All that matches say but their similarity, in the order of the fold."""
    return [
        [
            (
                m.det_id,
                m.run_id,
                m.pose,
                m.bbox,
                m.class_name,
                m.object_id,
                m.object_place,
                m.keyframe_place,
                m.object_estimate,
            )
            for m in sorted(row, key=lambda m: m.observation)
        ]
        for row in candidates.matches
    ]


def assert_equal(live: Candidates, exact: Candidates) -> None:
    """Both have the same matches, places and constants; cosines but for rounding."""
    assert found(live) == found(exact)
    assert live.constants == exact.constants
    for ours, theirs in zip(live.matches, exact.matches, strict=True):
        assert [m.similarity for m in ours] == pytest.approx(
            [m.similarity for m in theirs], abs=1e-5
        )
        for match in theirs:
            for place in {match.object_place, match.keyframe_place} - {None}:
                assert live.places[place] == exact.places[place]  # type: ignore[index]


def view_under_commands(log: Path) -> MapView:
    """The map of a log with the settings of its commands."""
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return fold_log(reader, corrections.settings or Settings(), corrections=corrections)[1]
