"""Commands compiled to corrections: undo, replacement, fingerprints."""

import hashlib

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.commands import (
    KINDS,
    Anchor,
    Command,
    CorrectedPose,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    ForgetRun,
    InvalidCommand,
    Join,
    JoinFrames,
    KeepApart,
    NamePlace,
    RigidTransform,
    Undo,
    UndoMerge,
    UseSettings,
    encode_command,
    parse_command,
)
from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId
from projections.fold.corrections import (
    NO_CORRECTIONS,
    Corrections,
    Keyframe,
    RecordedCommand,
    compile_corrections,
    map_fingerprint,
)
from projections.fold.settings import Settings

A, B, C = (Anchor(run_id=RunId("r"), keyframe_id=KeyframeId(k)) for k in (1, 2, 3))
KEY = [Keyframe(RunId("r"), KeyframeId(k)) for k in (1, 2, 3)]


def recorded(*commands: Command) -> list[RecordedCommand]:
    return [RecordedCommand(Offset(10 + n), command) for n, command in enumerate(commands)]


def head(number: int) -> dict[str, str]:
    return {"command_id": f"c{number}", "issued_by": "ann@lab"}


def moved_to(x: float) -> CorrectedPose:
    return CorrectedPose(keyframe_id=KeyframeId(1), x=x, y=0.0, yaw=0.0)


EVERY: list[Command] = [
    NamePlace(**head(0), place=A, name="kitchen"),
    KeepApart(**head(1), places=(A, B)),
    UndoMerge(**head(2), merge_offset=Offset(7), places=(A, B, C)),
    Join(**head(3), places=(B, C)),
    DropDetection(**head(4), det_ids=(DetId("d"),)),
    ForgetRun(**head(5), run_id=RunId("r"), reason="a test drive"),
    CorrectPoses(
        **head(6),
        run_id=RunId("r"),
        poses=(moved_to(1.0),),
    ),
    CorrectPoses(**head(7), run_id=RunId("r"), transform=RigidTransform.of(0.3, 0.0, 0.1)),
    JoinFrames(**head(8), frame="b", into="a", transform=RigidTransform.of(0.3, 0.0, 0.1)),
    UseSettings(**head(8), settings={"eps_m": 1.0}),
    Undo(**head(9), undone="c1"),
]


@pytest.mark.parametrize("command", EVERY, ids=lambda c: c.kind)
def test_a_command_is_read_as_it_was_written(command: Command) -> None:
    assert parse_command(encode_command(command)) == command
    assert command.kind in KINDS


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"{", "Invalid JSON"),
        (b"{}", "Unable to extract tag"),
        (b'{"kind":"sing"}', "which this version does not know"),
        (b'{"kind":"forget-run","command_id":"c","issued_by":"a","run_id":""}', "is empty"),
        (b'{"kind":"forget-run","command_id":"c","issued_by":"a","run_id":"r","x":1}', "x: Extra"),
        (b'{"kind":"correct-poses","command_id":"c","issued_by":"a","run_id":"r"}', "either poses"),
    ],
)
def test_what_is_no_command_is_refused_with_its_field(payload: bytes, says: str) -> None:
    with pytest.raises(InvalidCommand, match=says):
        parse_command(payload)


def test_no_commands_are_no_corrections() -> None:
    nothing = compile_corrections([])
    assert nothing.fingerprint() == NO_CORRECTIONS.fingerprint() == ""
    assert map_fingerprint(Settings(), nothing) == Settings().fingerprint()


def test_an_undone_command_is_as_if_it_had_never_been_given() -> None:
    apart = KeepApart(**head(0), places=(A, B))
    undo, again = Undo(**head(1), undone="c0"), Undo(**head(2), undone="c1")
    assert compile_corrections(recorded(apart, undo)).fingerprint() == ""
    assert [*compile_corrections(recorded(apart, undo, again)).apart] == [(KEY[0], KEY[1])]


def test_of_keep_apart_and_join_the_later_counts() -> None:
    commands = [KeepApart(**head(0), places=(B, A)), Join(**head(1), places=(A, B))]
    corrections = compile_corrections(recorded(*commands))
    assert (tuple(corrections.apart), corrections.joined) == ((), ((KEY[0], KEY[1]),))
    turned = compile_corrections(recorded(*commands[::-1]))
    assert (tuple(turned.apart), turned.joined) == (((KEY[0], KEY[1]),), ())


def test_an_undone_merge_keeps_every_two_of_its_places_apart() -> None:
    undone = UndoMerge(**head(0), merge_offset=Offset(7), places=(C, A, B))
    assert len([*compile_corrections(recorded(undone)).apart]) == 3


def test_pose_corrections_apply_in_the_order_of_the_commands() -> None:
    fixed = CorrectPoses(
        **head(0),
        run_id=RunId("r"),
        poses=(moved_to(4.0),),
    )
    moved = CorrectPoses(
        **head(1),
        run_id=RunId("r"),
        transform=RigidTransform.of(1.0, 0.0, 0.0),
        first=KeyframeId(1),
    )
    for commands, x in (((fixed, moved), 5.0), ((moved, fixed), 4.0)):
        pose = (0.0, 0.0, 0.0)
        for correction in compile_corrections(recorded(*commands)).poses[RunId("r")]:
            pose = correction.apply(KeyframeId(1), pose)
        assert pose[0] == x


@given(st.permutations(EVERY[:9]))
def test_any_commands_and_their_undos_are_no_corrections(commands: list[Command]) -> None:
    undos = [
        Undo(command_id=f"u{n}", issued_by="ann@lab", undone=command.command_id)
        for n, command in enumerate(commands)
    ]
    corrections = compile_corrections(recorded(*commands, *undos))
    assert (corrections.fingerprint(), corrections.settings, corrections.in_force) == ("", None, ())


def shifted(
    number: int, first: int | None, last: int | None, dx: float = 1.0, dyaw: float = 0.0
) -> CorrectPoses:
    transform = RigidTransform.of(dx, 0.0, dyaw)
    low, high = (None if k is None else KeyframeId(k) for k in (first, last))
    return CorrectPoses(
        **head(number), run_id=RunId("r"), transform=transform, first=low, last=high
    )


INDEPENDENT = [EVERY[n] for n in (0, 1, 4, 5, 6, 8)] + [
    shifted(20, 2, 5),
    shifted(21, 6, None, dyaw=0.5),
]


@given(st.permutations(INDEPENDENT))
def test_the_order_of_independent_commands_does_not_matter(commands: list[Command]) -> None:
    expected = compile_corrections(recorded(*INDEPENDENT)).fingerprint()
    assert compile_corrections(recorded(*commands)).fingerprint() == expected


def test_the_order_of_names_and_of_overlapping_corrections_matters() -> None:
    """Two anchors may come to be in one place, where the newer name counts."""
    kitchen, hall = EVERY[0], NamePlace(**head(1), place=B, name="hall")
    moved, turned = shifted(2, 1, 5), shifted(3, 5, 9, dyaw=0.5)
    fixed = EVERY[6]
    for one, other in ((kitchen, hall), (moved, turned), (fixed, moved)):
        forth, back = recorded(one, other), recorded(other, one)
        assert compile_corrections(forth).fingerprint() != compile_corrections(back).fingerprint()


def test_a_replaced_name_of_the_same_anchor_is_not_in_the_fingerprint() -> None:
    older, newer = EVERY[0], NamePlace(**head(1), place=A, name="hall")
    both, one = recorded(older, newer), recorded(newer)
    assert compile_corrections(both).fingerprint() == compile_corrections(one).fingerprint()


KEYFRAMES = st.integers(0, 5)


@st.composite
def pose_corrections(draw: st.DrawFn, number: int) -> CorrectPoses:
    if draw(st.booleans()):
        low, high = sorted((draw(KEYFRAMES), draw(KEYFRAMES)))
        first, last = draw(st.sampled_from([None, low])), draw(st.sampled_from([None, high]))
        dx, dyaw = draw(st.sampled_from([(1.0, 0.0), (0.0, 0.5), (2.0, 1.0)]))
        return shifted(number, first, last, dx, dyaw)
    found = draw(st.sets(KEYFRAMES, min_size=1, max_size=3))
    poses = tuple(
        CorrectedPose(keyframe_id=KeyframeId(k), x=float(number), y=0.0, yaw=0.0)
        for k in sorted(found)
    )
    return CorrectPoses(**head(number), run_id=RunId("r"), poses=poses)


def touched(correction: CorrectPoses) -> set[int]:
    """The keyframes from -1 to 6 that a correction can change."""
    if correction.transform is None:
        return {pose.keyframe_id for pose in correction.poses}
    first = -1 if correction.first is None else correction.first
    last = 6 if correction.last is None else correction.last
    return set(range(first, last + 1))


def by_keyframe(corrections: list[CorrectPoses]) -> list[list[str]]:
    """Which corrections apply to each keyframe, in order: what a normal order must keep."""
    return [[c.command_id for c in corrections if k in touched(c)] for k in range(-1, 7)]


@given(st.data())
def test_pose_corrections_have_one_fingerprint_if_each_keyframe_sees_one_order(
    data: st.DataObject,
) -> None:
    given_corrections = [
        data.draw(pose_corrections(n)) for n in range(data.draw(st.integers(2, 5)))
    ]
    other = data.draw(st.permutations(given_corrections))
    one, two = (compile_corrections(recorded(*c)) for c in (given_corrections, other))
    if by_keyframe(given_corrections) == by_keyframe(other):
        assert one.fingerprint() == two.fingerprint()
    if one.fingerprint() == two.fingerprint():
        for k in range(-1, 7):
            assert applied(one, k) == applied(two, k)


def applied(corrections: Corrections, keyframe: int) -> tuple[float, float, float]:
    pose = (1.0, 2.0, 3.0)
    for correction in corrections.poses[RunId("r")]:
        pose = correction.apply(KeyframeId(keyframe), pose)
    return pose


def test_the_fingerprint_is_of_the_pairs_that_are_apart() -> None:
    """So that of a log does not change with how the pairs are kept in memory."""
    corrections = compile_corrections(
        recorded(
            UndoMerge(**head(0), merge_offset=Offset(2), places=(A, B, C)),
            Join(**head(1), places=(A, B)),
            DifferentObjects(**head(2), det_ids=(DetId("b"), DetId('a"é'))),
        )
    )
    apart, joined = [(KEY[0], KEY[2]), (KEY[1], KEY[2])], [(KEY[0], KEY[1])]
    rows = [[], [], [], [], apart, joined, [('a"é', "b")], [], []]
    digest = hashlib.sha256(msgspec.json.encode(rows)).hexdigest()
    assert corrections.fingerprint() == digest[:16]
