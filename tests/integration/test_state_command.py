"""`mapfold state` as a person runs it."""

import json
from pathlib import Path

import pytest

from eventsrc.envelope.system_events import LOSS_KEY, Loss
from eventsrc.log import LogWriter
from projections.fold.place_types import place_type
from projections.fold.settings import Settings
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope, payload
from tests.support.folds import fold

KEY = "tb/detections"
DOCUMENTS = [
    envelope(i, x, 0.0, detections=[detection("cup", [1.0, 2.0], det_id=f"d{i}")])
    for i, x in enumerate([0.0, 0.1, 0.2, 5.0, 9.0, 9.1, 9.2])
] + [envelope(7, None)]


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log"
    with LogWriter(path) as writer:
        for document in DOCUMENTS[:4]:
            writer.append(KEY, payload(document), stamp_ns=10**18)
        loss = Loss(publisher="run-a", count=1, cause="keyframe_gap")
        writer.append(LOSS_KEY, loss.model_dump_json().encode())
        for document in DOCUMENTS[4:]:
            writer.append(KEY, payload(document), stamp_ns=2 * 10**18)
    return path


def test_the_document_says_what_was_seen(mapfold: Commands, log: Path) -> None:
    document = mapfold("state", log, "--json").json
    assert list(document) == [
        "offset",
        "settings",
        "digest",
        "counts",
        "keyframes",
        "places",
        "objects",
        "adjacency",
    ]
    assert document["offset"] == 9
    assert document["settings"] == Settings().model_dump()
    assert document["keyframes"][3] == {
        "run_id": "run-a",
        "keyframe_id": 3,
        "map_x": 5.0,
        "map_y": 0.0,
        "map_yaw": 0.0,
        "place_id": None,
    }
    assert document["keyframes"][7]["map_x"] is None
    kind = place_type({"cup": 1.0})
    assert kind is not None
    assert document["places"] == [
        {
            "place_id": "run-a_p0",
            "centroid_x": 0.1,
            "centroid_y": 0.0,
            "keyframe_count": 3,
            "type": None,
            "type_probability": kind.probability,
            "type_candidates": [{"type": t, "probability": p} for t, p in kind.candidates],
        },
        {
            "place_id": "run-a_p1",
            "centroid_x": 9.1,
            "centroid_y": 0.0,
            "keyframe_count": 3,
            "type": None,
            "type_probability": kind.probability,
            "type_candidates": [{"type": t, "probability": p} for t, p in kind.candidates],
        },
    ]
    first = document["objects"][0]
    assert (first["class_name"], first["place_id"], first["obs_count"]) == ("cup", "run-a_p0", 3)
    assert first["det_ids"] == ["d0", "d1", "d2"]
    assert (first["mean_x"], first["first_seen"], first["last_seen"]) == (
        0.1,
        1774357200.0,
        1774357202.0,
    )
    assert first["first_seen_iso"] == "2026-03-24T13:00:00.000Z"
    assert first["last_seen_iso"] == "2026-03-24T13:00:02.000Z"
    assert document["adjacency"] == [{"a": "run-a_p0", "b": "run-a_p1", "shared_transitions": 1}]
    assert document["counts"]["noise"] == 1


def test_the_digest_is_that_of_the_same_envelopes_folded_here(mapfold: Commands, log: Path) -> None:
    from projections.map.digest import map_digest

    said = mapfold("state", log, "--digest").out
    assert said == map_digest(fold(DOCUMENTS).view) + "\n"


def test_at_counts_events_and_includes_a_time_or_a_keyframe(mapfold: Commands, log: Path) -> None:
    def keyframes(at: str) -> int:
        return mapfold("state", log, "--json", "--at", at).json["counts"]["keyframes"]

    assert [keyframes(at) for at in ("0", "3", "5", "6", "end")] == [0, 3, 4, 5, 8]
    assert keyframes("run-a:4") == 5
    assert keyframes("2001-09-09T01:46:40Z") == 4  # 10**18 ns


def test_state_at_n_is_a_log_of_the_first_n_events(mapfold: Commands, tmp_path: Path) -> None:
    from projections.map.digest import map_digest

    path = tmp_path / "plain"
    with LogWriter(path) as writer:
        for document in DOCUMENTS:
            writer.append(KEY, payload(document))
    for n in range(len(DOCUMENTS) + 1):
        digest = mapfold("state", path, "--digest", "--at", str(n)).out.strip()
        assert digest == map_digest(fold(DOCUMENTS[:n]).view)


def test_settings_come_from_file_and_set_on_top(mapfold: Commands, log: Path) -> None:
    file = log.with_name("settings.json")
    file.write_text(json.dumps({"eps_m": 0.01, "min_samples": 7}))
    said = mapfold("state", log, "--json", "--settings", file, "--set", "eps_m=6").json
    assert said["settings"]["eps_m"] == 6.0
    assert [p["keyframe_count"] for p in said["places"]] == [7]


def test_the_text_is_a_short_table(mapfold: Commands, log: Path) -> None:
    lines = mapfold("state", log).out.splitlines()
    assert lines[0] == (
        "after 9 events: 1 run, 8 keyframes, 7 observations, 0 objects + 3 seen once, 2 places, "
        "1 keyframe in no place"
    )
    assert lines[1].startswith("settings default: eps_m=1.5, min_samples=3")
    assert lines[4].split() == ["p0", "3", "0", "(0.10,", "0.00)", "p1", "×1"]
    lines = mapfold("state", log, "--all").out.splitlines()
    assert lines[4].split() == ["p0", "3", "1", "(0.10,", "0.00)", "p1", "×1"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--set", "eps=1"], 2, "no setting 'eps'"),
        (["--set", "eps_m=-1"], 2, "eps_m"),
        (["--at", "10"], 2, "beyond the end"),
        (["--json", "--digest"], 2, "--json prints the digest too"),
        (["--settings", "absent.json"], 2, "absent.json"),
    ],
)
def test_misuse_is_one_line(
    mapfold: Commands, log: Path, arguments: list[str], code: int, words: str
) -> None:
    said = mapfold("state", log, *arguments, code=code)
    assert words in said.err
    assert len(said.err.splitlines()) == 1


def test_an_event_that_cannot_be_folded_is_named(mapfold: Commands, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "bad") as writer:
        writer.append(KEY, payload(DOCUMENTS[0]))
        writer.append(KEY, b"{}")
    said = mapfold("state", tmp_path / "bad", code=1)
    assert "event at offset 1 cannot be folded" in said.err
    assert mapfold("state", tmp_path / "bad", "--at", "1", "--digest").out.strip()
