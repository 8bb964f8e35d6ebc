"""`mapfold evaluate` on generated runs, and on the shared trial data where it is there."""

import copy
import gzip
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.buildings import Building, Keyframe, drive
from tests.support.commands import Commands
from tests.support.logs import write_log
from tests.support.shared_data import shared_run_path
from tests.support.thorough import rounds


@pytest.fixture(scope="module")
def mapfold(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    return Commands.in_folder(tmp_path_factory.mktemp("evaluate"))


def save(folder: Path, name: str, run: list[Keyframe]) -> tuple[Path, Path]:
    """A run as log and truth file."""
    documents = []
    for keyframe in run:
        document = msgspec.to_builtins(keyframe.accepted.envelope)
        for seen, vector in zip(document["detections"], keyframe.accepted.vectors, strict=True):
            assert vector is not None
            seen |= {"embedding_dim": len(vector), "embedding_model": "made"}
            seen["embedding"] = _base64(vector.tobytes())
        documents.append(document)
    truth = folder / f"{name}.truth.jsonl.gz"
    lines = [
        {
            "run_id": d["run_id"],
            "keyframe_id": d["keyframe_id"],
            "room": keyframe.room,
            "instances": keyframe.instances,
        }
        for d, keyframe in zip(documents, run, strict=True)
    ]
    truth.write_bytes(gzip.compress("\n".join(map(json.dumps, lines)).encode()))
    return write_log(folder / name, documents), truth


def _base64(data: bytes) -> str:
    import base64

    return base64.b64encode(data).decode()


@pytest.fixture(scope="module")
def runs(mapfold: Commands) -> list[str]:
    """Arguments: a mapped run, one of the same building, one of another."""
    building, stranger = Building(31, things=40), Building(32, things=40)
    arguments = []
    for flag, name, run in (
        ("--map", "a", drive(building, "a", 1, rounds(200, 60))),
        ("--query", "b", drive(building, "b", 2, 80)[-rounds(80, 30) :]),
        ("--query", "x", drive(stranger, "x", 3, 80)[-rounds(80, 20) :]),
    ):
        log, truth = save(mapfold.folder, name, run)
        arguments += [flag, str(log), "--truth", str(truth)]
    return arguments


@pytest.fixture(scope="module")
def scores(mapfold: Commands, runs: list[str]) -> Any:
    """What `evaluate` says of them, for all tests."""
    picture = mapfold.folder / "fails.png"
    said = mapfold("evaluate", *runs, "--json", "--picture", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    return said.json


def test_the_scores_have_their_shape_and_sense(scores: Any) -> None:
    assert set(scores["relocalization"]) == {"1", "2", "3", "5"}
    assert set(scores["views"]) == {"1", "3", "5"}
    assert "self" not in scores
    assert scores["places"]["keyframes"] <= 200
    assert 0 < scores["objects"]["instances"] <= 40
    three = scores["relocalization"]["3"]
    assert 0 < three["known"] < three["questions"]
    assert three["pose_error_m"]["p50"] < 0.5 * three["centroid_error_m"]["p50"]
    assert three["auroc"] > 0.9
    assert three["pose_error_m"]["p50"] < three["plain"]["pose_error_m"]["p50"]
    assert three["within_1_5_m"] > three["plain"]["within_1_5_m"]
    assert three["best_cosine"]["auroc"] > 0.8
    for column in (*scores["relocalization"].values(), *scores["views"].values()):
        assert 0.0 < column["known_ece_floor"] < 0.2


@pytest.mark.slow
def test_a_pose_may_lie_in_a_room_the_map_never_entered(
    mapfold: Commands, runs: list[str], scores: Any
) -> None:
    half = mapfold("evaluate", *runs, "--at", "25", "--json").json["relocalization"]["3"]
    whole = scores["relocalization"]["3"]
    assert half["room_ceiling"] < whole["room_ceiling"]
    assert half["pose_room"] <= half["room_ceiling"]
    assert whole["room_at_pose"] > 0.8


@pytest.mark.slow
def test_it_is_deterministic_but_for_latencies(
    mapfold: Commands, runs: list[str], scores: Any
) -> None:
    one, other = copy.deepcopy(scores), mapfold("evaluate", *runs, "--json").json
    for found in (one, other):
        for column in (*found["relocalization"].values(), *found["views"].values()):
            del column["latency_ms"]
    assert one == other


@pytest.mark.slow
def test_the_table_and_the_plain_method(mapfold: Commands, runs: list[str]) -> None:
    said = mapfold("evaluate", *runs, "--method", "plain")
    assert "re-localisation (plain)" in said.out
    assert "pose error p50" in said.out


def test_without_truth_no_perfect_scores_are_printed(mapfold: Commands, runs: list[str]) -> None:
    said = mapfold("evaluate", *runs[:2])
    assert said.err.startswith("no truth for any keyframe of ")
    places, objects, *_ = said.out.splitlines()
    assert re.fullmatch(r"places: number \d+, no room truth", places)
    assert re.fullmatch(r"objects: number \d+, no instance truth", objects)


def test_a_picture_that_cannot_be_written_does_not_cost_the_scores(
    mapfold: Commands, runs: list[str]
) -> None:
    picture = Path(runs[3]) / "fails.png"  # in a file
    said = mapfold("evaluate", *runs[:2], "--picture", picture, code=2)
    assert said.out.startswith("places: number ")
    assert f"mapfold: {picture}: cannot be written: File exists; choose another\n" in said.err


def test_the_map_is_asked_about_itself_without_truth(mapfold: Commands, runs: list[str]) -> None:
    found = mapfold("evaluate", *runs[:2], "--self", "--json").json
    own = found["self"]["3"]
    assert own["questions"] % 2 == 0  # each with the visit taken out, and with the things too
    assert 0 < own["known"] <= own["questions"] / 2
    assert own["pose_error_m"]["p50"] < own["plain"]["pose_error_m"]["p50"]
    assert own["known_called_unknown"] < 0.5 > own["taken_out_called_known"]


@pytest.mark.slow
def test_the_maps_own_questions_are_a_table_of_their_own(
    mapfold: Commands, runs: list[str]
) -> None:
    said = mapfold("evaluate", *runs[:2], "--self")
    first, *rest = said.out.splitlines()
    assert first.split() == ["the", "map's", "own", "questions", "1", "crop", "3", "crops"]
    assert {len(line) for line in (first, *rest)} == {50}
    assert said.err == ""
    both = mapfold("evaluate", *runs, "--self").out
    assert "re-localisation (joint)" in both
    assert "the map's own questions" in both


@pytest.mark.slow
def test_of_several_maps_the_worst_is_named(mapfold: Commands, runs: list[str]) -> None:
    other = ["--map", str(mapfold.folder / "x"), *runs]
    found = mapfold("evaluate", *other, "--json").json
    maps = [each["map"] for each in found["maps"]]
    assert maps == [str(mapfold.folder / "x"), runs[1]]
    assert found["worst"] in maps
    said = mapfold("evaluate", *other).out
    assert said.splitlines()[-1].startswith(f"worst map: {found['worst']}, 3 crops: pose error p50")
    assert said.count("re-localisation (joint)") == 2
    refused = mapfold("evaluate", *other, "--picture", "fails.png", code=2)
    assert "--picture draws one map; give one --map" in refused.err


@pytest.mark.slow
def test_of_several_maps_that_are_asked_about_themselves_the_worst_is_named(
    mapfold: Commands, runs: list[str]
) -> None:
    maps_alone = ["--map", str(mapfold.folder / "x"), *runs[:2], "--self"]
    own = mapfold("evaluate", *maps_alone, "--json").json
    ratios = {
        each["map"]: each["self"]["3"]["pose_error_m"]["p50"]
        / each["self"]["3"]["plain"]["pose_error_m"]["p50"]
        for each in own["maps"]
        if each["self"]["3"]["known"]
    }
    assert own["worst"] == max(ratios, key=ratios.__getitem__)
    said = mapfold("evaluate", *maps_alone).out
    assert said.splitlines()[-1].startswith(f"worst map: {own['worst']}, 3 crops: pose error p50")


@pytest.mark.parametrize(
    ("options", "unread"),
    [
        (["--method", "plain"], "--method plain"),
        (["--hfov", "90"], "--hfov"),
        (["--image", "640x480", "--hfov", "90"], "--hfov and --image"),
    ],
)
def test_options_that_the_maps_own_questions_do_not_read_are_misuse(
    mapfold: Commands, runs: list[str], options: list[str], unread: str
) -> None:
    said = mapfold("evaluate", *runs[:2], "--self", *options, code=2)
    assert f"{unread}: --self alone asks by the method joint" in said.err
    assert said.out == ""


def test_truth_that_fits_nothing_is_misuse(mapfold: Commands, runs: list[str]) -> None:
    broken = mapfold.folder / "broken.jsonl"
    broken.write_text('{"run_id": "a"}\n')
    said = mapfold("evaluate", *runs[:2], "--query", runs[5], "--truth", broken, code=2)
    assert "broken.jsonl, line 1" in said.err
    said = mapfold("evaluate", *runs[:2], "--query", runs[5], code=2)
    assert "--truth" in said.err


@pytest.mark.slow
def test_the_trial_house_is_found_again(mapfold: Commands) -> None:
    arguments: list[str] = []
    for flag, run in (("--map", "house-a"), ("--query", "house-c"), ("--query", "home-2")):
        path = shared_run_path(run)
        lines = gzip.decompress(path.read_bytes()).splitlines(True)
        asked = len(lines) if flag == "--map" else rounds(len(lines), len(lines) // 12)
        mapfold("import", mapfold.folder / run, "-", stdin=b"".join(lines[:asked]))
        truth = path.with_name(f"{run}.truth.jsonl.gz").resolve()
        arguments += [flag, str(mapfold.folder / run), "--truth", str(truth)]
    scores = mapfold("evaluate", *arguments, "--json").json["relocalization"]
    assert scores["3"]["pose_error_m"]["p50"] <= 0.3
    assert scores["3"]["pose_error_m"]["p90"] <= 0.8
    assert scores["1"]["pose_error_m"]["p50"] <= 0.6
    assert scores["3"]["auroc"] >= 0.99
    assert scores["3"]["known_called_unknown"] <= 0.02
    # Uncalibrated, the confidence is too low on this easy map, most with one crop.
    for crops, most in (("1", 0.24), ("2", 0.16), ("3", 0.12)):
        assert scores[crops]["ece"] <= most
        assert scores[crops]["known_ece"] <= 0.12
