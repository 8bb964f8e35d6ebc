"""Commands that show or correct a map folded by evidence, as a person runs them."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from projections.fold.settings import Settings
from tests.support.commands import Commands
from tests.support.evidence_drives import drive
from tests.support.walks import write_log

BY_EVIDENCE = ("--set", "fusion=evidence")
COUNT = 80


@pytest.fixture(scope="module")
def documents() -> list[dict[str, Any]]:
    return drive(5, COUNT, things=9)


@pytest.fixture
def log(tmp_path: Path, documents: list[dict[str, Any]]) -> Path:
    return write_log(tmp_path / "log", documents)


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def test_state_says_where_objects_stand(mapfold: Commands, log: Path) -> None:
    document = mapfold("state", log, "--json", *BY_EVIDENCE).json
    names = [Settings.model_validate(document["settings"]).fusion]
    assert names == ["evidence"]
    assert document["objects"]
    for row in document["objects"]:
        assert sum(row["class_counts"].values()) == row["obs_count"] == len(row["det_ids"])
        assert next(iter(row["class_counts"].values())) == row["class_counts"][row["class_name"]]
        assert row["est_sigma_m"] > 0
        assert row["spots"] >= 1
        assert isinstance(row["missing"], bool)
    text = mapfold("state", log, *BY_EVIDENCE).out
    assert "settings fusion=evidence\n" in text
    from_two = sum(row["spots"] > 1 for row in document["objects"])
    assert f"\nobjects  {from_two} seen from two spots or more" in text
    plain = mapfold("state", log, "--json").json
    assert plain["settings"] == Settings().model_dump()
    assert not {"est_x", "class_counts"} & plain["objects"][0].keys()


def test_merges_of_objects_say_why_and_why_tells_of_them(mapfold: Commands, log: Path) -> None:
    merges = mapfold("merges", log, "--objects", "--json", *BY_EVIDENCE).json
    assert merges, "this drive has some"
    text = mapfold("merges", log, "--objects", *BY_EVIDENCE).out.splitlines()
    assert len(text) == 1 + len(merges)
    for merge, line in zip(merges, text[1:], strict=True):
        evidence = merge["evidence"]
        assert merge["cause"] == "keyframe"
        assert f"{evidence['distance_m']:.2f} m apart, looks {evidence['look']:+.1f}" in line
    told = mapfold("why", log, merges[0]["absorbed"], "--json", *BY_EVIDENCE).json
    assert told["summary"].startswith(f"fused into {merges[0]['survivor']} at offset")
    assert told["entries"][-1]["evidence"] == merges[0]["evidence"]
    assert mapfold("merges", log, "--objects").out == "no merges of objects\n"


def test_why_and_diff_agree_with_state_at_any_offset(mapfold: Commands, log: Path) -> None:
    state = mapfold("state", log, "--json", "--at", "50", *BY_EVIDENCE).json
    row = max(state["objects"], key=lambda each: each["obs_count"])
    told = mapfold("why", log, row["object_id"], "--json", "--at", "50", *BY_EVIDENCE).json
    assert told["estimate"] == {
        "x": row["est_x"],
        "y": row["est_y"],
        "sigma_m": row["est_sigma_m"],
        "spots": row["spots"],
    }
    assert told["class_counts"] == row["class_counts"]
    assert (told["class_name"], told["missing"]) == (row["class_name"], row["missing"])
    changed = mapfold("diff", log, "50", "end", "--json", *BY_EVIDENCE).json["objects"]["changed"]
    before = {each["object_id"]: each["before"] for each in changed}
    assert before[row["object_id"]]["est_x"] == row["est_x"]


def test_bisect_counts_objects_of_a_class_as_they_are_called(mapfold: Commands, log: Path) -> None:
    found = mapfold("bisect", log, "object_count('cup') > 1", "--scan", "--json", *BY_EVIDENCE).json
    assert found["turns"], "this drive has some"
    for turn in found["turns"]:
        for at, side in ((turn["at"] - 1, "before"), (turn["at"], "after")):
            state = mapfold("state", log, "--json", "--at", str(at), *BY_EVIDENCE).json
            classes = Counter(row["class_name"] for row in state["objects"])
            assert turn[side] == {"object_count('cup')": classes["cup"]}


@pytest.mark.slow
def test_whatif_compares_both_rules_and_names_settings_by_group(
    mapfold: Commands, log: Path
) -> None:
    document = mapfold(
        "whatif", log, *BY_EVIDENCE, "--try", "fusion=evidence,evidence.range_m=1.3",
        "--json",
    ).json  # fmt: skip
    first, second = document["alternatives"]
    assert first["set"] == {"fusion": "evidence"}
    assert second["set"] == {"fusion": "evidence", "evidence.range_m": 1.3}
    assert first["digest"] == mapfold("state", log, "--digest", *BY_EVIDENCE).out.strip()
    text = mapfold("whatif", log, "--grid", "evidence.range_m=1.3,2.5", *BY_EVIDENCE).out
    assert "fusion=evidence evidence.range_m=1.3  " in text


def test_recorded_settings_are_listed_and_used(mapfold: Commands, log: Path) -> None:
    settings = mapfold.folder / "settings.json"
    settings.write_text(json.dumps({"fusion": "evidence", "camera": {"hfov_deg": 80}}))
    head = ("--reason", "r", "--issued-by", "me@here", "--command-id", "c1")
    mapfold("edit", log, "use-settings", settings, *head)
    assert "use-settings fusion=evidence, camera.hfov_deg=80.0 " in mapfold("edits", log).out
    with_set = mapfold("state", log, "--at", str(COUNT), "--json").json
    assert "est_x" not in with_set["objects"][0], "the command was not known then"
    now = mapfold("state", log, "--json").json
    assert now["settings"]["camera"]["hfov_deg"] == 80.0
    names = "fusion=evidence, camera.hfov_deg=80.0"
    assert f"settings {names}\n" in mapfold("state", log).out
    said = mapfold("edit", log, "use-settings", "--set", "camera.hfov_deg=80", *head[:4], code=2)
    assert "these are the settings of the log already" in said.err
    said = mapfold("state", log, "--set", "camera=80", code=2)
    assert "give one of them, such as camera.hfov_deg=90" in said.err


def test_objects_are_made_one_and_kept_apart(mapfold: Commands, log: Path) -> None:
    head = ("--reason", "r", "--issued-by", "me@here", *BY_EVIDENCE)
    objects = mapfold("state", log, "--json", *BY_EVIDENCE).json["objects"]
    first, second = (
        next(row for row in objects if row["class_name"] == name) for name in ("cup", "chair")
    )
    tried = mapfold(
        "edit", log, "same-object", first["object_id"], second["object_id"], *head, "--dry-run"
    ).out
    assert tried.startswith("same-object would change 0 places, ")
    mapfold("edit", log, "same-object", first["object_id"], second["object_id"], *head)
    now = mapfold("state", log, "--json", *BY_EVIDENCE).json["objects"]
    homes = [
        next(r["object_id"] for r in now if row["det_ids"][0] in r["det_ids"])
        for row in (first, second)
    ]
    assert homes[0] == homes[1]
    pair = max(objects, key=lambda row: len(row["det_ids"]))["det_ids"][:2]
    mapfold("edit", log, "different-objects", *pair, *head)
    now = mapfold("state", log, "--json", *BY_EVIDENCE).json["objects"]
    apart = [next(r["object_id"] for r in now if det_id in r["det_ids"]) for det_id in pair]
    assert apart[0] != apart[1]
    commands = mapfold("why", log, apart[0], *BY_EVIDENCE).out
    assert f"kept apart {pair[0]} and {pair[1]} by different-objects" in commands
