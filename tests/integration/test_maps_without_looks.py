"""Maps of detectors that give no embeddings, or give them late or at times: rows, questions and
commands."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader
from projections.fold.map_errors import QuestionError
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, rank, read_question
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader, relocalize
from tests.integration.test_projections import parsed
from tests.support.commands import Commands
from tests.support.envelopes import detection
from tests.support.evidence_drives import DIM, EVIDENCE, Without, drive, without_embeddings
from tests.support.ros_messages import base64_of
from tests.support.rows import all_rows, expected_graph
from tests.support.scenes import assert_equal
from tests.support.thorough import mostly_slow
from tests.support.walks import write_log

BY_EVIDENCE = ("--set", "fusion=evidence")
COUNT = 80
LEFT_OUT: list[Without] = ["none", "late", "half"]


def _documents(which: Without) -> list[dict[str, Any]]:
    return without_embeddings(drive(5, COUNT, things=9), which)


@pytest.fixture(params=mostly_slow(LEFT_OUT))
def documents(request: pytest.FixtureRequest) -> list[dict[str, Any]]:
    return _documents(request.param)


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A log without embeddings."""
    return write_log(tmp_path / "bare", _documents("none"))


def _view(log: Path, settings: Settings = EVIDENCE) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, settings)[1]


def _questions(**more: Any) -> list[dict[str, Any]]:
    """Detections of another drive through the same room, two of each picture or more."""
    asked = []
    for document in drive(5, COUNT, things=9)[1::7]:
        crops = [
            {"class": seen["class"], "bbox": seen["bbox"], **more}
            for seen in document["detections"]
        ]
        if len(crops) > 1:
            asked.append({"crops": crops})
    return asked


@pytest.mark.slow
def test_a_tail_has_the_rows_of_a_rebuild_and_both_those_of_the_fold(
    tmp_path: Path,
    documents: list[dict[str, Any]],
    one_database: Targets,
    third_database: Targets,
) -> None:
    log = tmp_path / "log"
    for start in range(0, len(documents), 40):
        write_log(log, documents[start : start + 40])
        tail(log, one_database, EVIDENCE, once=True, batch_events=13)
    report = rebuild(log, third_database, EVIDENCE)
    rows, view = all_rows(one_database), _view(log)
    assert rows == all_rows(third_database)
    assert report.digest == map_digest(view)
    graph = parsed(dict(rows[0]))
    assert graph == expected_graph(view)
    embedded = [o for o in view.observations if o.embedding is not None]
    assert [row[0] for row in rows[1]] == [o.ordinal + 1 for o in embedded]
    seen = {int(start): properties for _, start, _, properties in graph["OBSERVES"]}
    assert sum("similarity" in properties for properties in seen.values()) == sum(
        o.similarity_q40 is not None for o in view.observations
    )
    assert len(seen) > len(embedded)
    for checked in check(log, one_database, EVIDENCE):
        assert (checked.differing, checked.foreign) == (0, ())


def test_a_map_is_asked_by_classes_and_boxes(bare: Path, targets: Targets) -> None:
    rebuild(bare, targets, EVIDENCE)
    index = ExactIndex(_view(bare))
    with CandidateReader(targets) as reader:
        for document in _questions():
            crops = read_question(document).crops
            live, exact = reader.candidates(crops), index.search(crops)
            assert_equal(live, exact)
            assert all(live.matches)
            pose = rank(crops, live).pose
            assert pose is not None
            assert all(match.pose is not None for row in live.matches for match in row)


def test_embeddings_in_a_question_say_nothing_to_a_map_without(
    bare: Path, targets: Targets
) -> None:
    rebuild(bare, targets, EVIDENCE)
    index = ExactIndex(_view(bare))
    looked = detection("cup", [1.0] * DIM)
    for document in _questions():
        plain = read_question(document)
        again = read_question(
            {
                "crops": [
                    looked | {"class": crop["class"], "bbox": crop["bbox"], "det_id": f"d{n}"}
                    for n, crop in enumerate(document["crops"])
                ]
            }
        )
        found = index.search(again.crops)
        assert found.by_class
        assert found.matches == index.search(plain.crops).matches
        assert rank(again, found).known == 0.5
        live = relocalize(targets, again)
        exact = rank(again, found)
        assert (live.pose, live.places, live.known) == (exact.pose, exact.places, exact.known)


def test_a_class_that_a_map_lacks_is_left_out_if_a_detector_gave_it(bare: Path) -> None:
    index = ExactIndex(_view(bare))
    (document, *_) = _questions()
    known = document["crops"]
    odd = {"class": "lampp", "bbox": [10.0, 10.0, 60.0, 60.0]}
    found = index.search(read_question({"crops": [*known, odd]}).crops)
    assert found.matches == (*index.search(read_question(document).crops).matches, ())
    with pytest.raises(QuestionError, match="similar ones: lamp"):
        index.search(read_question({"crops": [odd]}).crops)
    with pytest.raises(QuestionError, match="similar ones: lamp"):
        index.search(read_question({"crops": [*known, {"class": "lampp"}]}).crops)


def test_observations_that_are_taken_out_are_no_matches_of_their_class(bare: Path) -> None:
    view = _view(bare)
    index = ExactIndex(view)
    crops = read_question(_questions()[0]).crops
    before = {match.observation for row in index.search(crops).matches for match in row}
    without = set(list(before)[::2])
    after = {m.observation for row in index.search(crops, without=without).matches for m in row}
    assert after
    assert not after & without


def test_the_first_embedding_decides_the_space_however_late_it_comes(tmp_path: Path) -> None:
    documents = _documents("late")
    other = detection("cup", [1.0] * (DIM + 1), bbox=[10.0, 10.0, 60.0, 60.0])
    documents[-1]["detections"].append(other | {"det_id": "foreign"})
    view = _view(write_log(tmp_path / "log", documents))
    foreign = [o for o in view.observations if o.foreign_space]
    assert [o.det_id for o in foreign] == ["foreign"]
    assert foreign[0].object is None
    half = len(documents) // 2
    posed = [o for o in view.observations if view.keyframes[o.keyframe].pose and o not in foreign]
    assert all(o.object is not None for o in posed)
    assert any(o.embedding is not None for o in posed)
    assert all(o.embedding is None for o in view.observations if o.keyframe < half // 2)


def test_by_the_other_rule_they_are_of_no_object(bare: Path) -> None:
    assert not _view(bare, Settings()).objects


class TestCommands:
    """As a person runs them."""

    @pytest.fixture
    def mapfold(self, tmp_path: Path) -> Commands:
        return Commands.in_folder(tmp_path)

    def test_why_state_and_merges_tell_of_a_map_without_looks(
        self, mapfold: Commands, bare: Path
    ) -> None:
        state = mapfold("state", bare, "--json", *BY_EVIDENCE).json
        assert state["digest"] == map_digest(_view(bare, Settings(fusion="evidence")))
        most = max(state["objects"], key=lambda each: each["obs_count"])
        text = mapfold("why", bare, most["object_id"], *BY_EVIDENCE).out
        assert f"seen {most['obs_count']} times, on average" in text
        assert "similarity" not in text
        assert mapfold("merges", bare, "--objects", "--json", *BY_EVIDENCE).json

    def test_state_says_which_rule_needs_no_embedding(self, mapfold: Commands, bare: Path) -> None:
        advice = "no detection has an embedding, so there are no Objects; --preset full needs none"
        assert advice in mapfold("state", bare).err.splitlines()
        assert advice not in mapfold("state", bare, "--preset", "full").err
        assert advice not in mapfold("state", bare, "--at", "0").err

    def test_a_map_without_looks_is_calibrated_but_for_likenesses(
        self, mapfold: Commands, bare: Path
    ) -> None:
        said = mapfold("calibrate", bare, "--json").json
        hint = "no observation has an embedding: the constants of likeness are left as they are"
        assert hint in said["hints"]
        counts = {each["name"]: each["count"] for each in said["constants"]}
        assert counts["evidence.range_m"] > 0
        assert counts["evidence.same_back"] == counts["evidence.different"] == 0
        values = {each["name"]: (each["value"], each["prior"]) for each in said["constants"]}
        assert values["evidence.same_back"][0] == values["evidence.same_back"][1]

    @pytest.mark.slow
    def test_a_drive_without_looks_is_evaluated_by_classes(
        self, mapfold: Commands, bare: Path, tmp_path: Path
    ) -> None:
        truth = tmp_path / "truth.jsonl"
        rows = {(e["run_id"], e["keyframe_id"]): e for e in _documents("none")}
        truth.write_text(
            "".join(
                json.dumps(
                    {
                        "run_id": run,
                        "keyframe_id": number,
                        "room": "room",
                        "instances": [seen["class"] for seen in e["detections"]],
                    }
                )
                + "\n"
                for (run, number), e in rows.items()
            )
        )
        said = mapfold(
            *("evaluate", "--map", bare, "--query", bare, "--truth", truth, "--json"), *BY_EVIDENCE
        ).json
        assert said["relocalization"]["1"]["questions"] > 20
        assert said["relocalization"]["2"]["pose_error_m"]["p50"] < 1.0


def _changed(log: Path, documents: list[dict[str, Any]], **fields: Any) -> Path:
    """A file of JSON lines, with the first detection of the first picture changed."""
    (first, *others) = documents
    one, *rest = first["detections"]
    changed = {**one, "embedding_dim": DIM, **fields}
    lines = [{**first, "detections": [changed, *rest]}, *others]
    log.write_text("\n".join(map(json.dumps, lines)))
    return log


BAD_VECTORS: list[tuple[dict[str, Any], str]] = [
    ({"embedding": base64_of([0.0] * DIM)}, "is the zero vector"),
    ({"embedding": base64_of([math.nan] * DIM)}, "holds NaN or infinity"),
    ({"embedding": base64_of([1.0] * DIM), "embedding_dim": DIM + 3}, "bytes do not match"),
    ({"embedding": ""}, "0 bytes do not match embedding_dim"),
    ({"embedding": "!!!"}, "not base64"),
]


@pytest.mark.parametrize("which", mostly_slow(LEFT_OUT))
@pytest.mark.slow
def test_a_bad_vector_among_detections_without_is_kept_as_rejected(
    mapfold: Commands, which: Without
) -> None:
    documents = drive(5, 30, things=9)
    kept = without_embeddings(documents[1:], which)
    for number, (fields, reason) in enumerate(BAD_VECTORS):
        file = _changed(mapfold.folder / f"{number}.jsonl", [documents[0], *kept], **fields)
        said = mapfold("import", f"log{number}", file, "--preset", "full", code=3).err
        assert f"{file.name}: line 1: rejected: detections.0.embedding" in said
        assert reason in said
        counts = mapfold("state", f"log{number}", "--json").json["counts"]
        write_log(mapfold.folder / f"good{number}", kept)
        good = mapfold("state", f"good{number}", "--json", "--preset", "full").json["counts"]
        assert counts == good | {"events": good["events"] + 2}
        assert mapfold("find", f"log{number}", kept[0]["detections"][0]["class"]).out


def test_a_bad_vector_in_a_question_is_refused_whatever_the_map_has(
    mapfold: Commands, tmp_path: Path
) -> None:
    (asked, *_) = _questions()
    for which in ("none", "half"):
        write_log(tmp_path / which, _documents(which))
        for values, dim, reason in (
            ([0.0] * DIM, DIM, "crops.0.embedding: holds NaN or infinity, or only zeros"),
            ([math.nan] * DIM, DIM, "crops.0.embedding: holds NaN or infinity, or only zeros"),
            ([1.0] * DIM, DIM + 3, f"holds {DIM} numbers, embedding_dim says {DIM + 3}"),
        ):
            first, *others = asked["crops"]
            looked = {**first, "embedding": base64_of(values), "embedding_dim": dim}
            file = tmp_path / "question.json"
            file.write_text(json.dumps({"crops": [looked, *others]}))
            words = ("relocalize", file, "--log", which, *BY_EVIDENCE)
            assert reason in mapfold(*words, code=2).err
    looked |= {"embedding": base64_of([1.0] * 7), "embedding_dim": 7}
    file.write_text(json.dumps({"crops": [looked, *others]}))
    said = mapfold("relocalize", file, "--log", "half", *BY_EVIDENCE, code=2).err
    assert f"the question's embeddings have 7 dimensions, the map's {DIM}" in said
    said = mapfold("relocalize", file, "--log", "none", *BY_EVIDENCE)
    assert "the map has no embeddings, so those of 1 crop say nothing: asked by class" in said.err
    file.write_text(json.dumps(asked))
    plain = mapfold("relocalize", file, "--log", "none", *BY_EVIDENCE)
    assert plain.out == said.out
    assert "the map has no embeddings" not in plain.err


def test_state_counts_what_one_rule_leaves_out(mapfold: Commands, tmp_path: Path) -> None:
    write_log(tmp_path / "half", _documents("half"))
    said = mapfold("state", "half").err
    assert "detections have no embedding and are of no Object; --preset full needs none" in said
    assert "no Object" not in mapfold("state", "half", "--preset", "full").err
