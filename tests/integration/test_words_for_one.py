"""One place is no "1 places": in what commands say, and on pictures."""

import re
from pathlib import Path

import pytest

from tests.commands import Commands
from tests.envelopes import detection, envelope
from tests.fixtures_timetravel import write_log

_LONE = ("--set", "min_samples=1", "--set", "eps_m=0.5")
_ONES = re.compile(r"(?<![\d.,])1 (place|keyframe|object|event|map)s\b")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    """Beside a log of three keyframes; the third makes two places of one keyframe one."""
    cup = detection("cup", [1.0, 0.0])
    xs = {1: 0.0, 2: 1.0, 3: 0.5}
    write_log(
        tmp_path / "log",
        [envelope(n, x, detections=[cup] if n == 1 else []) for n, x in xs.items()],
    )
    return Commands.in_folder(tmp_path)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("diff", "log", "0", "1", *_LONE), "1 keyframe around"),
        (("diff", "log", "2", "3", *_LONE), "(1 keyframe) into"),
        (("diff", "log", "3", "0", *_LONE), None),
        (("merges", "log", "--show", "1", *_LONE), "absorbed  run-a_p1, 1 keyframe"),
        (("state", "log", "--at", "1", *_LONE), "1 place"),
        (("draw", "log", "--at", "1", "--out", "one.svg", *_LONE), "1 place, 1 object"),
    ],
)
def test_one_is_singular(mapfold: Commands, args: tuple[str, ...], says: str | None) -> None:
    said = mapfold(*args)
    told = said.out + said.err
    for picture in mapfold.folder.glob("*.svg"):
        told += picture.read_text("utf-8")
    assert says is None or says in told
    assert not _ONES.search(told), told
