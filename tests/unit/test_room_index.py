"""The room at a position: by other keyframes of this building, never by the one asked from."""

from projections.localize.evaluate.trials import RoomIndex
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from tests.support.buildings import Building, drive

HOME, STRANGER = Building(41, things=12), Building(42, things=12)
MAPPED, ASKED = drive(HOME, "a", 1, 40), drive(HOME, "b", 2, 40)
FOREIGN = drive(STRANGER, "x", 3, 40)


def truth() -> Truth:
    lines = [
        TrueKeyframe(
            run_id=k.accepted.envelope.run_id,
            keyframe_id=k.accepted.envelope.keyframe_id,
            room=f"foreign {k.room}" if k in FOREIGN else k.room,
            instances=k.instances,
        )
        for k in (*MAPPED, *ASKED, *FOREIGN)
    ]
    return Truth({(line.run_id, line.keyframe_id): line for line in lines})


ROOMS = RoomIndex([k.accepted for k in MAPPED], [k.accepted for k in (*ASKED, *FOREIGN)], truth())


def test_a_keyframes_position_is_in_its_room() -> None:
    for keyframe in MAPPED:
        at = keyframe.accepted.envelope
        assert at.map_x is not None
        assert at.map_y is not None
        assert ROOMS.room(at.map_x, at.map_y, ("nobody", 0)) == keyframe.room


def test_another_buildings_runs_name_no_room_here() -> None:
    for keyframe in FOREIGN:
        at = keyframe.accepted.envelope
        room = ROOMS.room(at.map_x or 0.0, at.map_y or 0.0, ("nobody", 0))
        assert room is not None
        assert not room.startswith("foreign")


def test_the_keyframe_asked_from_is_left_out() -> None:
    only = [MAPPED[0].accepted]
    rooms = RoomIndex(only, [], truth())
    assert rooms.room(0.0, 0.0, ("nobody", 0)) == MAPPED[0].room
    assert rooms.room(0.0, 0.0, ("a", only[0].envelope.keyframe_id)) is None
