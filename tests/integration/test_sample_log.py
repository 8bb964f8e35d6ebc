"""`logs/sample`: small, whole, and what scripts/make_sample would write again today."""

from pathlib import Path

from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import LogReader
from eventsrc.record.log_info import log_info
from projections.surfaces.python import Timeline, fold
from scripts.programs.sample import make_sample
from tests.support.logs import SAMPLE, simulated


def test_it_is_one_sealed_segment_of_at_most_two_megabytes() -> None:
    info = log_info(SAMPLE)
    assert len(info.segments) == 1
    assert info.segments[0].sealed
    assert info.size_bytes <= 2_000_000
    assert (info.rejected, info.lost) == (0, 0)


def test_it_has_settings_and_walls_and_the_simulated_run_byte_for_byte() -> None:
    with LogReader(SAMPLE) as reader:
        events = list(reader.read())
    assert [event.payload for event in events[2:]] == list(simulated(7, "a").payloads)
    assert [event.offset for event in events] == list(range(len(events)))
    assert [event.key for event in events[:2]] == [COMMAND_KEY, MAP_KEY]
    assert {event.key for event in events[2:]} == {"tb/detections"}


def test_it_is_made_again_event_for_event(tmp_path: Path) -> None:
    make_sample(tmp_path / "again")
    found = []
    for log in (SAMPLE, tmp_path / "again"):
        with LogReader(log) as reader:
            found.append([(e.key, e.logged_ns, e.stamp_ns, e.payload) for e in reader.read()])
    assert found[0] == found[1]


def test_its_places_are_its_rooms_and_the_ends_of_the_hall_become_one() -> None:
    """Eight rooms, eight places. The robot drives from end to end of the hall at the bridge."""
    run = simulated(7, "a")
    rooms = {line["keyframe_id"]: line["room"] for line in run.truth}
    state = fold(SAMPLE).state
    assert len(state["places"]) == len(run.house.plan.rooms) == 8
    most = {
        place["place_id"]: [
            rooms[k["keyframe_id"]]
            for k in state["keyframes"]
            if k["place_id"] == place["place_id"]
        ]
        for place in state["places"]
    }
    named = {place: max(sorted(set(seen)), key=seen.count) for place, seen in most.items()}
    assert sorted(named.values()) == sorted(room.name for room in run.house.plan.rooms)
    with Timeline(SAMPLE, cache=False) as timeline:
        (merge,) = timeline.merges()
        before = timeline.at(merge["offset"]).state["keyframes"]
    parts = {merge["survivor"], *merge["absorbed"]}
    joined = [rooms[k["keyframe_id"]] for k in before if k["place_id"] in parts]
    assert named[merge["survivor"]] == "hall" == rooms[merge["keyframe_id"]]
    assert joined.count("hall") >= 0.9 * len(joined)
