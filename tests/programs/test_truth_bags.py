"""Maps of bags against the truth: the table of ``scripts/bench_truth --bags``."""

from pathlib import Path

import pytest

from projections.fold.deltas import KeyframeOrdinal, KeyframePlaced, PlaceFormed, PlaceOrdinal
from scripts.programs.bench.truth.bags import bag_row, bags_table, score_bag
from scripts.programs.bench.truth.scoring import score_objects
from scripts.programs.bench.truth.worlds import NoWorldsError, case_folder
from tests.programs.truth_cases import hand_made, trial_generator


def test_an_object_counts_in_the_room_of_most_keyframes_of_its_place() -> None:
    """Two places, each in a room of its own; the truth has a third one, which no keyframe is in."""
    sights = [("run-a", float(k), 0.0, f"w/cup-{k // 3}", k // 3) for k in range(9)]
    placed = [
        each
        for place in (0, 1)
        for each in (
            PlaceFormed(10, PlaceOrdinal(place), f"run-a_p{place}", KeyframeOrdinal(3 * place)),
            *(KeyframePlaced(10, KeyframeOrdinal(3 * place + k), PlaceOrdinal(place))
              for k in range(3)),
        )
    ]  # fmt: skip
    view, truth = hand_made(sights, placed)
    keyframes = {
        key: each.model_copy(update={"room": "west" if key[1] < 3 else "east"})
        for key, each in truth.keyframes.items()
    }
    truth = type(truth)(keyframes)
    for ordinal, found in view.objects.items():
        found.confirmed, found.place = True, PlaceOrdinal(min(ordinal, 1))
    rooms: dict[str, str | None] = {"w/cup-0": "west", "w/cup-1": "west", "w/cup-2": "cellar"}
    row = score_bag("rover w", view, truth, rooms, score_objects(view, truth, {}))
    assert (row.keyframes, row.places, row.rooms) == (9, 2, 2)
    assert (row.confirmed, row.driven, row.in_room) == (3, 2, 1)
    assert row.in_room_share == 0.5
    assert row.objects.ratio == 1.0
    table = bags_table([row, row]).splitlines()
    assert table[1].startswith("rover w")
    assert table[-1].split()[-3:] == ["6", "4", "0.500"]


def test_a_folder_without_the_maker_of_bags_is_named(tmp_path: Path) -> None:
    with pytest.raises(NoWorldsError, match=r"make_bag\.py is absent; give its folder by --worlds"):
        bag_row(tmp_path / "make_bag.py", tmp_path, "rover", "tb3_house")


@pytest.mark.slow
def test_a_bag_is_made_imported_and_scored(tmp_path: Path) -> None:
    generator = trial_generator()
    pytest.importorskip("rosbags")
    pytest.importorskip("PIL")
    folder = case_folder(generator, "rover", "tb3_house", 0.0, 40, 0, tmp_path)
    maker = Path(str(generator.__file__)).parent / "make_bag.py"
    if not maker.exists():
        pytest.skip(f"{maker} is absent")
    row = bag_row(maker, folder, "rover", "tb3_house")
    assert 20 <= row.keyframes <= 40
    assert row.objects.instances > 0
    assert row.confirmed > 0
