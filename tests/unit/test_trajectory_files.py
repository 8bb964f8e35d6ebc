"""Trajectory files: three formats, what is wrong with a file and at which line."""

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.trajectory import MAX_LINE, Trajectory, TrajectoryError, read_trajectory

Poses = list[tuple[float, float, float, float]]
METRES = st.floats(-1e7, 1e7)
POSES = st.lists(
    st.tuples(st.floats(0.0, 9e9), METRES, METRES, st.floats(-math.pi, math.pi)),
    min_size=1,
    max_size=20,
    unique_by=lambda pose: pose[0],
)


def _read(folder: Path, text: str | bytes, name: str = "poses.txt") -> Trajectory:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_trajectory(path)


def _tum(poses: Poses) -> str:
    rows = [
        (t, x, y, 0.5, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)) for t, x, y, yaw in poses
    ]
    return "# stamp x y z qx qy qz qw\n" + "".join(" ".join(map(repr, r)) + "\n" for r in rows)


def _csv(poses: Poses) -> str:
    return "stamp,note,x,y,yaw\n" + "".join(
        f'{t!r},"a, b",{x!r},{y!r},{yaw!r}\n' for t, x, y, yaw in poses
    )


def _json_lines(poses: Poses) -> str:
    rows = ({"timestamp": t, "map_x": x, "map_y": y, "map_yaw": yaw} for t, x, y, yaw in poses)
    return "".join(f"{json.dumps(row)}\n\n" for row in rows)


@given(poses=POSES)
def test_all_formats_say_the_same(poses: Poses, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("poses")
    found = [_read(folder, write(poses)) for write in (_tum, _csv, _json_lines)]
    for trajectory in found:
        assert trajectory.by == "stamp"
        assert [tuple(p[:3]) for p in trajectory.poses] == sorted(p[:3] for p in poses)
        for pose, (_, _, _, yaw) in zip(trajectory.poses, sorted(poses), strict=True):
            assert abs(math.remainder(pose.yaw - yaw, math.tau)) < 1e-9
    assert [p.yaw for p in found[1].poses] == [p[3] for p in sorted(poses)]


def test_keyframe_ids_of_64_bits_are_exact(tmp_path: Path) -> None:
    ids = [-(2**63), 2**53, 2**53 + 1, 2**63 - 1]
    text = "keyframe_id,x,y,yaw\n" + "".join(f"{i},1,2,3\n" for i in reversed(ids))
    found = _read(tmp_path, text)
    assert found.by == "keyframe"
    assert [pose.key for pose in found.poses] == ids


def test_a_keyframe_id_is_taken_before_a_stamp(tmp_path: Path) -> None:
    found = _read(tmp_path, "stamp,keyframe_id,x,y,qx,qy,qz,qw\n5.5,7,1,2,0,0,0.6,0.8\n")
    (pose,) = found.poses
    assert (found.by, pose.key, pose.line) == ("keyframe", 7, 2)
    assert pose.yaw == pytest.approx(2 * math.atan2(0.6, 0.8))


@pytest.mark.parametrize("name", ["a.csv", "a.tum", "a.jsonl", "a"])
def test_the_content_says_the_format_whatever_the_name(tmp_path: Path, name: str) -> None:
    assert _read(tmp_path, "1.0 2 3 0 0 0 0 1\n", name).poses[0][:4] == (1.0, 2.0, 3.0, 0.0)
    assert _read(tmp_path, '\ufeff{"keyframe_id": 1, "x": 2, "y": 3, "yaw": 0}\n', name).poses
    assert _read(tmp_path, "keyframe_id,x,y,yaw\n1,2,3,0\n", name).poses


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no pose in it; a trajectory is TUM"),
        ("# nothing\n\n", "no pose in it"),
        ("keyframe_id,x,y,yaw\n", "no pose in it"),
        ("1 2 3\n", "line 1: 3 numbers instead of 8"),
        ("1 2 3 0 0 0 0 1\n2 2 3 0 0 0", "line 2: 6 numbers instead of 8"),
        ("1 2 3 0 0 0 0 1\n2 nan 3 0 0 0 0 1\n", "line 2: x is nan"),
        ("1 2 3 0 0 0 0 1\n2 1e999 3 0 0 0 0 1\n", "line 2: x is inf"),
        ("1 2 3 0 0 0 0 1\n2 1e8 3 0 0 0 0 1\n", "line 2: x is 100000000, beyond"),
        ("1 2 3 0 0 0 0 0\n", "line 1: the quaternion has length 0 instead of 1"),
        ("1774357234500000000 2 3 0 0 0 0 1\n", "it looks like nanoseconds"),
        ("-1 2 3 0 0 0 0 1\n", "line 1: stamp -1: not seconds"),
        ("1 2 3 0 0 0 0 1\n\n1 2 3 0 0 0 0 1\n", "line 3: stamp 1.0 is on line 1 too"),
        ("one,two\n1,2\n", "line 1: neither keyframe_id nor stamp among one, two"),
        ("stamp,x,yaw\n1,2,3\n", "line 1: no y among stamp, x, yaw"),
        ("stamp,x,y\n1,2,3\n", "line 1: neither yaw nor qx, qy, qz, qw"),
        ("stamp,x,x,y,yaw\n", "line 1: a column stands twice"),
        ("stamp,x,y,yaw\n1,2,3\n", "line 2: 3 columns instead of the 4 of the header"),
        ("stamp,x,y,yaw\n1,,3,4\n", "line 2: x is empty"),
        ("stamp,x,y,yaw\n,2,3,4\n", "line 2: stamp is no number: ''"),
        ('stamp,x,y,yaw\n1,"2,3,4\n', "line 2: no CSV"),
        ("keyframe_id,x,y,yaw\n1.5,2,3,4\n", "line 2: keyframe_id is no whole number: '1.5'"),
        (f"keyframe_id,x,y,yaw\n{2**63},2,3,4\n", "has more than 64 bits"),
        ('{"keyframe_id": 1, "x": 2, "y": 3, "yaw"', "line 1: no JSON"),
        ('{"stamp": 1, "x": 2, "y": 3, "yaw": null}', "line 1: qx is no number: None"),
        ('{"stamp": 1, "x": true, "y": 3, "yaw": 0}', "line 1: x is no number: True"),
        ('{"stamp": 1, "x": [], "y": 3, "yaw": 0}', "line 1: x is no number: []"),
        ('{"keyframe_id": true, "x": 1, "y": 3, "yaw": 0}', "keyframe_id is no whole number"),
        ('{"stamp": NaN, "x": 1, "y": 3, "yaw": 0}', "line 1: stamp is nan"),
        (
            '{"stamp": 1, "x": 1, "y": 3, "yaw": 0}\n{"keyframe_id": 1, "x": 1, "y": 3, "yaw": 0}',
            "line 2: a keyframe here and a stamp before",
        ),
        ('{"stamp": 1, "x": 1, "y": 3, "yaw": 0}\n[]', "line 2: no JSON object"),
        ("hello\n", "line 1: hello begins no trajectory"),
        ("\x1b[2Jhello", r"line 1: \x1b[2Jhello begins no trajectory"),
        (b"\xff\xfe\x00\x01", "line 1: no UTF-8 text"),
        (b"1 2 3 0 0 0 0 1\n\x80", "line 2: no UTF-8 text"),
        (b"\x00" * 100_000, f"line 1: longer than {MAX_LINE:,} characters"),
        ("[" * 3000, "begins no trajectory"),
        ('{"a":' * 700 + "1", "line 1: no JSON"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, text: str | bytes, says: str) -> None:
    with pytest.raises(TrajectoryError) as caught:
        _read(tmp_path, text)
    message = str(caught.value)
    assert says in message
    assert message.startswith(str(tmp_path / "poses.txt"))
    assert message.isprintable()


def test_an_endless_file_is_refused_at_once() -> None:
    with pytest.raises(TrajectoryError, match="not a regular file"):
        read_trajectory(Path("/dev/zero"))


@pytest.mark.parametrize("name", ["missing", "."])
def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(TrajectoryError, match=r"No such file|Is a directory"):
        read_trajectory(tmp_path / name)


@given(text=st.binary(max_size=300))
def test_any_bytes_are_poses_or_an_error(
    text: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("poses")
    try:
        found = _read(folder, text)
    except TrajectoryError:
        return
    assert found.poses


@given(poses=POSES, data=st.data())
def test_of_a_cut_file_only_the_last_pose_can_be_wrong_and_is_told(
    poses: Poses, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("poses")
    write = data.draw(st.sampled_from([_tum, _csv, _json_lines]))
    whole = write(poses)
    cut = whole[: data.draw(st.integers(0, len(whole)))]
    lines = [line for line in cut.split("\n")[:-1] if line]
    count = len(lines) - (write is not _json_lines)
    try:
        found = _read(folder, cut)
    except TrajectoryError:
        return
    expected = {p[:3] for p in poses[: max(count, 0)]}
    read = {tuple(p[:3]) for p in found.poses}
    assert expected <= read
    if write is _json_lines:
        assert read <= {p[:3] for p in poses[: count + 1]}
    else:
        assert len(read) - len(expected) == (found.is_open and len(read) > len(expected))
