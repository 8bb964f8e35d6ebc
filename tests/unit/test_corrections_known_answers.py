"""Small worlds under commands, whose answers are known."""

from typing import Any

import pytest

from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectedPose,
    CorrectPoses,
    DifferentObjects,
    DropObject,
    Join,
    KeepApart,
    NamePlace,
    RigidTransform,
    SameObject,
)
from eventsrc.envelope.model import Offset
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.deltas import MergeRefused, ObjectsMerged, PlaceLink, PlacesMerged
from projections.fold.map_errors import ImpossibleCommand
from projections.fold.objects import object_id
from projections.fold.settings import Settings
from projections.map.changes import ChangeTracker
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, accepted

HEAD = {"issued_by": "ann@lab"}


def at(keyframe: int) -> Anchor:
    return Anchor(run_id="run-a", keyframe_id=keyframe)


def apart(a: int, b: int) -> KeepApart:
    return KeepApart(command_id=f"apart {a} {b}", places=(at(a), at(b)), **HEAD)


def join(a: int, b: int) -> Join:
    return Join(command_id=f"join {a} {b}", places=(at(a), at(b)), **HEAD)


def same(a: str, b: str) -> SameObject:
    return SameObject(command_id=f"same {a} {b}", det_ids=(a, b), **HEAD)


def different(a: str, b: str) -> DifferentObjects:
    return DifferentObjects(command_id=f"different {a} {b}", det_ids=(a, b), **HEAD)


def compiled(*commands: Command) -> Corrections:
    return compile_corrections(RecordedCommand(Offset(90 + n), c) for n, c in enumerate(commands))


def under(*commands: Command, **settings: Any) -> Folded:
    return Folded.start(Settings(**settings), corrections=compiled(*commands))


def line(*xs: float, first: int = 0) -> list[dict[str, Any]]:
    return [envelope(first + n, x, 0.0) for n, x in enumerate(xs)]


ROOMS = [*line(0.0, 0.1, 0.2), *line(2.6, 2.7, 2.8, first=3)]


def labels(folded: Folded) -> list[int | None]:
    return [k.place for k in folded.view.keyframes]


def test_a_bridge_between_places_kept_apart_joins_the_first_and_is_reported_once() -> None:
    folded = under(apart(3, 0)).extend([*ROOMS, *line(1.3, 1.35, 1.4, first=6)])
    assert labels(folded) == [0, 0, 0, 1, 1, 1, 0, 0, 0]
    link = PlaceLink(core=6, neighbour=3, distance_um=1_300_000)
    assert folded.all(MergeRefused) == [MergeRefused(6, 0, 1, 6, link, apart=(0, 3))]
    assert folded.all(PlacesMerged) == []


def test_a_place_that_may_join_either_of_two_kept_apart_joins_the_first() -> None:
    """A third room between the two: the door to the second stays shut for both."""
    rooms = [*line(0.0, 0.1, 0.2), *line(6.0, 6.1, 6.2, first=3), *line(3.0, 3.1, 3.2, first=6)]
    doors = line(1.6, 4.6, first=9)
    folded = under(apart(0, 3)).extend([*rooms, *doors])
    assert labels(folded) == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert [(d.a, d.b, d.apart) for d in folded.all(MergeRefused)] == [(0, 1, (0, 3))]
    turned = under(apart(0, 3)).extend([*rooms, *doors[::-1]])
    assert labels(turned)[6:9] == [1, 1, 1]


def test_a_cell_with_keyframes_of_two_places_is_of_the_first_and_they_stay() -> None:
    """Two border keyframes of one cell, of the two places, become core together."""
    rooms = [*line(-0.35, -1.0, -1.1, -1.2), *line(3.5, 4.2, 4.3, 4.4, first=4)]
    folded = under(apart(0, 4), min_samples=4).extend([*rooms, *line(2.05, 1.1, 1.6, first=8)])
    assert labels(folded) == [0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 0]
    assert [(d.a, d.b) for d in folded.all(MergeRefused)] == [(0, 1)]


def test_two_anchors_in_one_cell_are_of_one_place() -> None:
    assert labels(under(apart(0, 1)).extend(line(0.0, 0.1, 0.2))) == [0, 0, 0]


def test_joined_places_are_one_as_soon_as_both_are_there() -> None:
    folded = under(join(4, 1)).extend([*line(0.0, 0.1, 0.2), *line(9.0, 9.1, 9.2, 9.3, first=3)])
    (merge,) = folded.all(PlacesMerged)
    assert (merge.offset, merge.survivor, merge.absorbed, merge.joined) == (5, 0, (1,), (1,))
    assert merge.links == (PlaceLink(core=4, neighbour=1, distance_um=9_000_000),)
    assert labels(folded) == [0] * 7
    assert folded.view.places[0].keyframe_count == 7


def test_what_is_kept_apart_from_one_of_joined_places_is_kept_apart_from_both() -> None:
    far = line(20.0, 20.1, 20.2, first=10)
    folded = under(join(0, 10), apart(10, 3)).extend([*ROOMS, *line(1.3, first=6), *far])
    assert labels(folded) == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]


def test_a_join_of_places_that_grew_into_conflict_is_refused() -> None:
    """The joined anchor comes when its place holds what is kept apart from the other's place."""
    late = envelope(20, 2.75, 0.0)
    folded = under(join(0, 20), apart(0, 3)).extend([*ROOMS, late])
    assert labels(folded) == [0, 0, 0, 1, 1, 1, 1]
    assert [(d.a, d.b, d.link) for d in folded.all(MergeRefused)] == [
        (0, 1, PlaceLink(core=6, neighbour=0, distance_um=2_750_000))
    ]


LOOK, OTHER = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]


def sees(keyframe: int, *seen: tuple[str, list[float]], x: float = 0.0, name: str = "cup") -> Any:
    detections = [detection(name, look, det_id=det_id) for det_id, look in seen]
    return envelope(keyframe, x, 0.0, detections=detections)


def objects(folded: Folded) -> list[list[str]]:
    return [
        [folded.view.observations[i].det_id for i in o.observations]
        for o in folded.view.objects.values()
    ]


def test_objects_that_are_the_same_are_one_with_all_their_observations() -> None:
    folded = under(same("b1", "a1")).extend(
        [sees(0, ("a1", LOOK)), sees(1, ("b0", OTHER), x=2.0), sees(2, ("b1", OTHER), x=2.0)]
    )
    assert objects(folded) == [["a1", "b0", "b1"]]
    (merge,) = folded.all(ObjectsMerged)
    assert merge == ObjectsMerged(2, 0, 1, 3, 4_000_000, 0, 1774357200.0, 1774357202.0)
    (found,) = folded.view.objects.values()
    assert (found.object_id, found.mean_x) == (object_id("a1"), 4.0 / 3)


def test_an_object_of_two_classes_is_found_as_either() -> None:
    folded = under(same("a", "b")).extend(
        [sees(0, ("a", LOOK)), sees(1, ("b", LOOK), name="mug"), sees(2, ("c", LOOK), name="mug")]
    )
    assert objects(folded) == [["a", "b", "c"]]


def test_objects_that_differ_are_two_however_alike() -> None:
    folded = under(different("a", "b")).extend(sees(n, (d, LOOK)) for n, d in enumerate("abc"))
    assert objects(folded) == [["a", "c"], ["b"]]


def test_an_observation_keeps_away_from_what_its_own_object_is_kept_apart_from() -> None:
    """b is the same as a, whose Object has c, which differs from d: so b is not d's either."""
    folded = under(same("a", "b"), different("c", "d")).extend(
        [sees(0, ("a", LOOK)), sees(1, ("c", LOOK)), sees(2, ("d", [0.9, 0.1, 0.0])),
         sees(3, ("b", [0.9, 0.1, 0.0]))]
    )  # fmt: skip
    assert objects(folded) == [["a", "c", "b"], ["d"]]


def test_what_an_absorbed_object_was_seen_from_votes_once_it_has_a_place() -> None:
    folded = under(same("a", "b")).extend(
        [sees(0, ("a", LOOK)), sees(1, ("y", OTHER), x=9.0), sees(2, ("b", OTHER), x=9.0)]
    )
    assert [o.place for o in folded.view.objects.values()] == [None]
    folded.extend(line(9.1, 9.2, first=3))
    assert [o.place for o in folded.view.objects.values()] == [0]


def test_a_dropped_object_is_not_founded_and_its_keyframe_stays() -> None:
    drop = DropObject(command_id="d", det_ids=("a", "b"), **HEAD)
    folded = under(drop).extend([sees(0, ("a", LOOK), ("c", OTHER)), sees(1, ("b", LOOK))])
    assert objects(folded) == [["c"]]
    assert folded.view.counts()["dropped"] == 2


def test_a_keyframe_without_a_pose_can_be_given_one_and_moved_after() -> None:
    given = CorrectPoses(
        command_id="p", run_id="run-a", poses=(CorrectedPose(keyframe_id=0, x=1, y=2, yaw=0),),
        **HEAD,
    )  # fmt: skip
    moved = CorrectPoses(
        command_id="m", run_id="run-a", transform=RigidTransform.of(0.5, 0.0, 0.0), **HEAD
    )
    folded = under(given, moved).extend([envelope(0, None), envelope(1, None)])
    assert [k.pose and (k.pose.x_m, k.pose.y_m) for k in folded.view.keyframes] == [(1.5, 2), None]


def test_a_pose_moved_out_of_the_map_is_an_error_that_changes_nothing() -> None:
    away = CorrectPoses(
        command_id="m", run_id="run-a", transform=RigidTransform.of(1e7, 0.0, 0.0), **HEAD
    )
    back = CorrectPoses(
        command_id="b", run_id="run-a", transform=RigidTransform.of(0.0, 2.0, 0.0), **HEAD
    )
    folded = under(back, away, back.model_copy(update={"command_id": "again"}))
    says = (
        r"correct-poses m at offset \d+ moves keyframe 0 of run 'run-a'.*edit LOG undo m --reason"
    )
    with pytest.raises(ImpossibleCommand, match=says):
        folded.extend([envelope(0, 1.0, 0.0)])
    assert folded.map.next_offset == 0
    assert len(folded.map.folded_ids.offsets) == 0


def test_a_batch_names_what_a_merge_of_objects_changed() -> None:
    folded = under(same("a", "b")).extend([sees(0, ("a", LOOK)), sees(1, ("y", OTHER), x=2.0)])
    tracker = ChangeTracker(folded.view)
    deltas = folded.map.fold(Offset(2), accepted(sees(2, ("b", OTHER), x=2.0)))
    tracker.apply_event(Offset(2), deltas, 0)
    changes = tracker.drain()
    assert (changes.objects, changes.reassigned, changes.located) == ([0, 1], [1], [1])
    assert list(folded.view.objects) == [0]
    for delta in deltas:  # applying one twice does no harm
        folded.view.apply(delta)
    assert objects(folded) == [["a", "y", "b"]]
    assert folded.view.objects[0].obs_count == 3


def test_a_command_sent_twice_counts_once() -> None:
    name = NamePlace(command_id="n", place=at(0), name="hall", **HEAD)
    other = NamePlace(command_id="n", place=at(0), name="bath", **HEAD)
    assert [n.name for n in compiled(name, name, other).names] == ["hall"]
