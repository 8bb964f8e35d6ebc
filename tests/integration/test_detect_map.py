"""The map made from drawn pictures is as right as that of the simulator's own detector."""

import json
import threading
from pathlib import Path

import pytest

from eventsrc.adapters.sim import build_house
from tests.support.commands import Commands
from tests.support.drawn_pictures import camera_pictures, write_pictures
from tests.support.models import models_for
from tests.support.scenes import truth_of


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("run", ["a", "b"])
def test_objects_and_rooms_are_as_with_the_built_in_detector(tmp_path: Path, run: str) -> None:
    """V against the truth within 0.05, of objects under the default rule and of places as rooms."""
    mapfold = Commands.in_folder(tmp_path)
    detector, encoder = models_for(build_house(7), tmp_path)
    write_pictures(camera_pictures(run=run), tmp_path / "camera", threading.Event())
    mapfold(
        *("detect", "--images", "camera", "--poses", "camera/poses.csv", "--out", "seen.jsonl"),
        *("--detector", detector, "--encoder", encoder, "--threads", "1"),
    )
    envelopes = [json.loads(line) for line in (tmp_path / "seen.jsonl").read_text().splitlines()]
    truth = truth_of(envelopes, tmp_path / "camera" / "truth.jsonl")
    (tmp_path / "seen.truth.jsonl").write_text("\n".join(map(json.dumps, truth)))
    mapfold("simulate", "--run", run, "--out", "built.jsonl")
    scores = {}
    for name in ("seen", "built"):
        mapfold("import", name, f"{name}.jsonl")
        words = ("evaluate", "--map", name, "--truth", f"{name}.truth.jsonl", "--json")
        objects = mapfold(*words).json["objects"]["v_measure"]
        places = mapfold(*words, "--preset", "rooms").json["places"]["v_measure"]
        scores[name] = (objects, places)
    assert scores["seen"] == pytest.approx(scores["built"], abs=0.05)
    assert scores["seen"][0] > 0.8
