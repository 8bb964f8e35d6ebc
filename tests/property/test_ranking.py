"""Properties of the ranking, on generated buildings with the true rooms as Places."""

import itertools
import math
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.localize.relocalize import Answer, MapCandidates, QuestionCrop, rank
from tests.support.buildings import Building, Keyframe, drive
from tests.support.scenes import RoomMap, crops_of
from tests.support.thorough import examples, mostly_slow

SEEDS = (20, 21)


@cache
def room_map(seed: int) -> RoomMap:
    return RoomMap(drive(Building(seed, things=40), f"r{seed}-a", seed, 250))


@cache
def other_session(seed: int) -> list[Keyframe]:
    run = drive(Building(seed, things=40), f"r{seed}-b", seed + 100, 120)
    return [keyframe for keyframe in run if len(keyframe.instances) >= 3]


def place_rank(answer: Answer, room: str) -> float:
    ids = [place.place_id for place in answer.places]
    return ids.index(room) if room in ids else math.inf


def error_of(answer: Answer, keyframe: Keyframe) -> float:
    """Distance of the answer's pose from the keyframe's, in metres."""
    assert answer.pose is not None
    at = keyframe.accepted.envelope
    return math.hypot(answer.pose.x - (at.map_x or 0.0), answer.pose.y - (at.map_y or 0.0))


def is_at_a_door(mapped: RoomMap, keyframe: Keyframe) -> bool:
    """Whether the next keyframe of the map, 0.5 m away, is in another room."""
    at = keyframe.accepted.envelope
    x, y = at.map_x or 0.0, at.map_y or 0.0
    others = [k.accepted.envelope for k in mapped.run if k.room != keyframe.room]
    return any(math.hypot((e.map_x or 0.0) - x, (e.map_y or 0.0) - y) < 0.51 for e in others)


@given(st.sampled_from(SEEDS), st.data())
@settings(max_examples=examples(25), deadline=None)
def test_the_order_of_crops_does_not_matter(seed: int, data: st.DataObject) -> None:
    keyframe = data.draw(st.sampled_from(other_session(seed)))
    crops = crops_of(keyframe)[:4]
    shuffled = data.draw(st.permutations(crops))
    mapped = room_map(seed)
    for method in ("joint", "plain"):
        one = rank(crops, mapped.search(crops), method=method)
        assert rank(shuffled, mapped.search(shuffled), method=method) == one


@given(st.sampled_from(SEEDS), st.data())
@settings(max_examples=examples(25), deadline=None)
def test_asking_twice_gives_the_same_answer_to_the_last_bit(seed: int, data: st.DataObject) -> None:
    crops = crops_of(data.draw(st.sampled_from(other_session(seed))))
    mapped = room_map(seed)
    again = RoomMap(mapped.run)
    assert rank(crops, mapped.search(crops)) == rank(crops, again.search(crops))


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_one_more_consistent_crop_never_lowers_the_true_place(seed: int) -> None:
    """Noise-free: the crops are the map's own observations of one keyframe."""
    mapped = room_map(seed)
    seen = [k for k in mapped.run if len(k.instances) >= 3 and None not in k.instances][::7]
    assert len(seen) > 5
    for keyframe in seen:
        crops = crops_of(keyframe)[:3]
        answers = [
            rank(part, mapped.search(part), top=len(mapped.rooms))
            for part in (crops[:1], crops[:2], crops)
        ]
        ranks = [place_rank(answer, keyframe.room) for answer in answers]
        assert error_of(answers[-1], keyframe) <= 0.3
        if is_at_a_door(mapped, keyframe):  # half of the pose's weight may lie in the next room
            shares = {place.place_id: place.score for place in answers[-1].places}
            assert max(ranks) <= 1
            assert shares[keyframe.room] > 0.4
            continue
        for fewer, more in itertools.pairwise(ranks):
            assert more <= fewer
        assert ranks[-1] == 0


@pytest.mark.parametrize("boxes", [True, False], ids=["boxes", "no boxes"])
@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_scores_are_shares_and_confidence_a_probability(seed: int, boxes: bool) -> None:
    mapped = room_map(seed)
    for keyframe in other_session(seed)[::5]:
        crops = crops_of(keyframe, boxes=boxes)
        answer = rank(crops, mapped.search(crops), top=len(mapped.rooms))
        scores = [place.score for place in answer.places]
        assert scores == sorted(scores, reverse=True)
        assert sum(scores) == pytest.approx(1.0)
        assert 0.0 <= answer.confidence <= 1.0
        assert all(place.evidence for place in answer.places)


def median_error(seed: int, count: int, *, plain: bool) -> float:
    mapped, errors = room_map(seed), []
    for keyframe in other_session(seed):
        crops = crops_of(keyframe)[:count]
        answer = rank(crops, mapped.search(crops), method="plain" if plain else "joint")
        centres = {
            room: [k.accepted.envelope for k in mapped.run if k.room == room]
            for room in mapped.rooms
        }
        assert answer.pose is not None
        x, y = answer.pose.x, answer.pose.y
        if plain:
            members = centres[answer.places[0].place_id]
            x = sum(e.map_x or 0.0 for e in members) / len(members)
            y = sum(e.map_y or 0.0 for e in members) / len(members)
        truth = keyframe.accepted.envelope
        errors.append(math.hypot(x - (truth.map_x or 0.0), y - (truth.map_y or 0.0)))
    return sorted(errors)[len(errors) // 2]


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_the_pose_is_twice_as_near_as_the_rooms_centre(seed: int) -> None:
    assert 2.0 * median_error(seed, 3, plain=False) <= median_error(seed, 3, plain=True)


def test_questions_from_another_building_are_unknown() -> None:
    mapped = room_map(SEEDS[0])
    strangers = drive(Building(99, things=40), "stranger", 7, 80)
    answers = [
        rank(crops, mapped.search(crops))
        for keyframe in strangers
        if len(crops := crops_of(keyframe)) >= 2
    ]
    assert len(answers) > 10
    assert sum(answer.unknown for answer in answers) >= 0.95 * len(answers)


def test_without_candidates_the_answer_is_empty() -> None:
    crop: list[QuestionCrop] = crops_of(other_session(SEEDS[0])[0])[:1]
    answer = rank(crop, MapCandidates(((),), {}))
    assert (answer.places, answer.pose, answer.confidence) == ((), None, 0.0)
    assert answer.unknown
