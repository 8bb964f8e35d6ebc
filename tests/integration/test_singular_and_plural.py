"""Counts of one are singular in messages and pictures: "1 place", not "1 places"."""

import json
import re
from pathlib import Path

import pytest

from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.walks import write_log

_LONE = ("--set", "min_samples=1", "--set", "eps_m=0.5")
_ONES = re.compile(
    r"(?<![\d.,])1 ((shared |more )?"
    r"(place|keyframe|object|event|map|merge|time|transition|crop|dimension|label)s|more classes)\b"
)


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    """Beside a log of three keyframes; the third makes two places of one keyframe one.

    A cup is seen twice, then another cup and a thing of each of eight classes; all of these twice
    in the log ``again``.
    """
    cup, *more = [detection("cup", [1.0, 0.0]), detection("cup", [0.0, 1.0])]
    more += [detection(f"thing {n}", [1.0, 0.0]) for n in range(8)]
    drive = [
        envelope(1, 0.0, detections=[cup]),
        envelope(2, 1.0, detections=[cup]),
        envelope(3, 0.5, detections=more),
    ]
    write_log(tmp_path / "log", drive)
    write_log(tmp_path / "again", [*drive, envelope(4, 1.0, detections=more)])
    (tmp_path / "flat.json").write_text(json.dumps([{"embedding": [1.0]}]))
    return Commands.in_folder(tmp_path)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("diff", "log", "0", "1", *_LONE), "1 keyframe around"),
        (("diff", "log", "2", "3", *_LONE), "(1 keyframe) into"),
        (("diff", "log", "3", "0", *_LONE), None),
        (("diff", "log", "2", "1", *_LONE), "seen 2 → 1 time\n"),
        (("why", "log", "p0", *_LONE), "1 object + 9 seen once: cup; next to"),
        (("why", "again", "p0", *_LONE), "10 objects: cup ×2, thing 0, thing 1, "),
        (("why", "again", "p0", *_LONE), "thing 6 and 1 more class; next to"),
        (("why", "log", "--same", "run-a:1", "run-a:2", "--set", "min_samples=2"), "1 event after"),
        (("draw", "log", "--out", "all.svg", "--all"), " seen once, "),
        (("merges", "log", "--show", "1", *_LONE), "absorbed  p1, 1 keyframe"),
        (("state", "log", "--at", "1", *_LONE), "1 place"),
        (
            ("draw", "log", "--at", "1", "--out", "one.svg", *_LONE),
            "0 objects + 1 seen once",
        ),
    ],
)
def test_one_is_singular(mapfold: Commands, args: tuple[str, ...], says: str | None) -> None:
    said = mapfold(*args)
    told = said.out + said.err
    for picture in mapfold.folder.glob("*.svg"):
        told += picture.read_text("utf-8")
    assert says is None or says in told
    assert not _ONES.search(told), told


def test_a_question_of_one_dimension(mapfold: Commands) -> None:
    said = mapfold("relocalize", "flat.json", "--log", "log", code=2).err
    assert "have 1 dimension, the map's 2" in said
