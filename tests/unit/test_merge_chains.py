"""Merges: three places joined by one keyframe, and a bridging keyframe that is no core point."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from eventsrc.base.errors import MisuseError
from projections.adapters.drawing.merge_picture import draw_merge
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.merge_reasons import chains_of, merge_reason
from projections.history.names import keyframe_name
from tests.support.envelopes import envelope
from tests.support.walks import write_log

ARMS = [(-3, 0), (-2, 0), (-1, 0), (3, 0), (2, 0), (1, 0), (0, 3), (0, 2), (0, 1)]
"""Three places of three keyframes on the arms of a star, the last of each 1 m from its middle."""


@contextmanager
def drive(
    folder: Path, spots: list[tuple[float, float]], min_samples: int = 3
) -> Iterator[LogTimeline]:
    documents = [envelope(n, float(x), float(y)) for n, (x, y) in enumerate(spots)]
    rules = Settings(eps_m=1.0, min_samples=min_samples)
    with LogTimeline(write_log(folder / "log", documents), rules) as opened:
        yield opened


def names(opened: LogTimeline, keyframes: tuple[int, ...]) -> list[str]:
    return [keyframe_name(opened.history, k).removeprefix("run-a:") for k in keyframes]


def test_one_keyframe_merges_three_places(tmp_path: Path) -> None:
    with drive(tmp_path, [*ARMS, (0, 0)]) as opened:
        (merge,) = opened.merges()
        assert (merge.survivor, merge.absorbed, merge.absorbed_sizes) == (0, (1, 2), (3, 3))
        chains = chains_of(opened.history, merge)
        assert [names(opened, chain.points) for chain in chains] == [
            ["1", "2", "9", "5", "4"],
            ["1", "2", "9", "8", "7"],
        ]
        assert [(chain.joined, chain.absorbed) for chain in chains] == [(0, 1), (0, 2)]
        draw_merge(opened.knowing(), merge, tmp_path / "hub.png")
        assert (tmp_path / "hub.png").stat().st_size > 10_000


def test_a_keyframe_between_two_places_is_a_core_point_itself(tmp_path: Path) -> None:
    xs = (0, 0.5, 1, 3, 3.5, 4, 2)
    with drive(tmp_path, [(x, 0) for x in xs]) as opened:
        (merge,) = opened.merges()
        assert merge_reason(opened.history, merge) == (
            "run-a:6 made itself a core point: "
            "run-a:2 (run-a_p0) –1.000 m– run-a:6 –1.000 m– run-a:3 (run-a_p1)"
        )


def test_the_bridging_keyframe_may_be_no_part_of_the_chain(tmp_path: Path) -> None:
    """1.0 lacks one neighbour of four until a keyframe comes beside it that is no core point."""
    spots = [(x, 0.0) for x in (-0.4, -0.3, -0.2, 0.1, 1.9, 2.2, 2.3, 2.4, 1.0)] + [(1.0, 0.95)]
    with drive(tmp_path, spots, min_samples=4) as opened:
        (merge,) = opened.merges()
        assert not opened.history.neighbours.is_core(merge.bridge, opened.end)
        assert merge_reason(opened.history, merge) == (
            "run-a:9 made run-a:8 a core point: "
            "run-a:3 (run-a_p0) –0.900 m– run-a:8 –0.900 m– run-a:4 (run-a_p1)"
        )


def test_pictures_have_one_of_three_suffixes(tmp_path: Path) -> None:
    with drive(tmp_path, [*ARMS, (0, 0)]) as opened, pytest.raises(MisuseError, match="a picture"):
        draw_merge(opened.knowing(), opened.merges()[0], tmp_path / "hub.gif")
