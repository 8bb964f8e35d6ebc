"""Candidates from one database or two equal those of exact search in the folded map."""

import json
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from eventsrc.log import LogReader
from projections.fold.map_errors import ProjectionMismatch, ProjectionMissing, QuestionError
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, QuestionCrop, rank, read_question
from projections.localize.relocalize.track import Track
from projections.map.fold import fold_log
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader, relocalize
from projections.postgres.status import projection_status
from projections.postgres.vector_sink import build_hnsw
from tests.support.commands import Commands
from tests.support.envelopes import detection
from tests.support.logs import WEIRD, walk, write_log
from tests.support.scenes import assert_equal, found
from tests.support.thorough import mostly_slow, rounds

SETTINGS = Settings()
CAMERA = {"hfov_deg": 50.3, "width_px": 640.0, "height_px": 480.0, "yaw_rad": -0.7}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two runs, since matches of different runs are treated differently; the robot of the second
    states its camera."""
    other = [{**each, "camera": CAMERA} for each in walk(30, seed=4, run_id="run-c")]
    return write_log(tmp_path / "log", [*walk(60, seed=3), *other])


@pytest.fixture(params=mostly_slow(["evidence", "page"]))
def rule(request: pytest.FixtureRequest) -> Settings:
    return Settings(fusion=request.param)


@pytest.fixture
def view(log: Path, rule: Settings) -> MapView:
    return view_of(log, rule)


def view_of(log: Path, settings: Settings) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, settings)[1]


@pytest.fixture
def targets(targets: Targets, log: Path, rule: Settings) -> Targets:
    """With the map of the log."""
    rebuild(log, targets, rule)
    return targets


def questions() -> Iterator[tuple[QuestionCrop, ...]]:
    for document in walk(12, seed=9, run_id="run-b"):
        if document["detections"]:
            yield read_question(document).crops


def test_candidates_are_those_of_exact_search(targets: Targets, view: MapView) -> None:
    index = ExactIndex(view)
    with CandidateReader(targets) as reader:
        asked = 0
        for crops in questions():
            live, exact = reader.candidates(crops, 200), index.search(crops, 200)
            assert_equal(live, exact)
            taken = {(m.run_id, m.camera) for row in live.matches for m in row}
            assert taken == {("run-a", None), ("run-c", tuple(CAMERA.values()))}
            asked += 1
        assert asked > 5
        nothing = reader.candidates(())
        assert (nothing.matches, dict(nothing.places)) == ((), {})


def test_what_the_index_finds_is_compared_by_whole_vectors(targets: Targets, view: MapView) -> None:
    with CandidateReader(targets) as reader:
        vectors = reader._vectors
        assert build_hnsw(vectors, threshold=1).built
        vectors.execute("SET enable_seqscan = off")  # where the index can be used, it is
        for crops in questions():
            assert_equal(reader.candidates(crops), ExactIndex(view).search(crops))
        vectors.execute("SELECT pg_stat_force_next_flush()")
        (searches,) = vectors.execute(
            "SELECT idx_scan FROM pg_stat_user_indexes"
            " WHERE indexrelname = 'detection_embeddings_halves'"
        ).fetchone() or (0,)
        assert searches
        with pytest.raises(QuestionError, match="expected 3 dimensions"):
            reader.candidates(read_question([detection("cup", [1.0, 0.0, 0.0])]).crops)


def test_the_server_plans_a_question_a_few_times_only(targets: Targets, view: MapView) -> None:
    """Also when the index is disabled, which a plan that was kept obeys."""
    crops = next(questions())[:1]
    expected = ExactIndex(view).search(crops)
    with CandidateReader(targets) as reader:

        def plans() -> tuple[int, int]:
            """Times that a search was run by a plan that was kept, and by one made for it."""
            counted = "SELECT sum(generic_plans), sum(custom_plans) FROM pg_prepared_statements"
            where = " WHERE statement LIKE '%<=>%'"
            row = reader._vectors.execute((counted + where).encode()).fetchone()
            assert row is not None
            return int(row[0]), int(row[1])

        for _ in range(16):
            assert_equal(reader.candidates(crops), expected)
        kept, made = plans()
        assert kept >= 5
        reader.disable_index()
        for _ in range(3):
            assert_equal(reader.candidates(crops), expected)
        assert plans() == (kept + 3, made)


def test_the_library_call_answers_and_refuses_another_embedding_space(
    targets: Targets, view: MapView
) -> None:
    index = ExactIndex(view)
    for crops in questions():
        live, exact = relocalize(targets, crops), rank(crops, index.search(crops))
        assert [p.place_id for p in live.places] == [p.place_id for p in exact.places]
        assert live.confidence == pytest.approx(exact.confidence, abs=0.02)
    with pytest.raises(QuestionError, match="dimensions"):
        relocalize(targets, read_question([detection("cup", [1.0, 0.0, 0.0])]).crops)
    other = detection("cup", [1.0] * 8, embedding_model="another/model")
    with pytest.raises(QuestionError, match="another/model"):
        relocalize(targets, read_question([other]).crops)


@pytest.mark.slow
def test_a_graph_by_evidence_goes_with_vectors_of_the_other_rule(
    log: Path, two_databases: Targets
) -> None:
    """The rule changes Objects alone, which are in the graph."""
    evidence = Settings(fusion="evidence")
    rebuild(log, two_databases, SETTINGS, only="vectors")
    rebuild(log, two_databases, evidence, only="graph")
    crops = next(questions())
    ours, theirs = (ExactIndex(view_of(log, s)).search(crops, 200) for s in (evidence, SETTINGS))
    assert found(ours) != found(theirs)
    with CandidateReader(two_databases) as reader:
        assert found(reader.candidates(crops, 200)) == found(ours)
    rebuild(log, two_databases, SETTINGS, only="graph")
    with CandidateReader(two_databases) as reader:
        assert found(reader.candidates(crops, 200)) == found(theirs)


@pytest.mark.parametrize("targets", ["two_databases", "one_database"][: rounds(2, 1)])
@pytest.mark.parametrize("other", mostly_slow(["log", "settings"]))
def test_graph_and_vectors_of_different_origin_are_refused(
    request: pytest.FixtureRequest, targets: str, other: str, log: Path, tmp_path: Path
) -> None:
    found: Targets = request.getfixturevalue(targets)
    second = write_log(tmp_path / "second", walk(60, seed=3)) if other == "log" else log
    settings = SETTINGS if other == "log" else Settings.model_validate({"eps_m": 1.0})
    rebuild(log, found, SETTINGS, only="graph")
    rebuild(second, found, settings, only="vectors")
    said = {"log": "the graph from log", "settings": "with other settings than the graph"}[other]
    with pytest.raises(
        ProjectionMismatch, match=rf"{said}.* run `mapfold replay` without --only"
    ) as told:
        relocalize(found, next(questions()))
    assert len(str(told.value).splitlines()) == 1
    rebuild(second, found, settings, only="graph")
    assert relocalize(found, next(questions())).places


def test_an_empty_database_says_what_to_do(one_database: Targets) -> None:
    with pytest.raises(ProjectionMissing, match="mapfold replay"):
        relocalize(one_database, read_question([detection("cup", [1.0] * 8)]).crops)


def test_a_map_of_another_version_is_refused_until_it_is_made_again(
    log: Path, one_database: Targets
) -> None:
    rebuild(log, one_database, SETTINGS)
    crops = next(questions())
    with psycopg.connect(one_database.vector_url, autocommit=True) as connection:
        connection.execute("ALTER TABLE detection_embeddings DROP COLUMN camera")
        connection.execute("COMMENT ON SCHEMA mapfold IS 'mapfold: progress'")
    again = "an older mapfold made the .*camera.*run `mapfold replay`, which makes it again"
    with pytest.raises(ProjectionMismatch, match=again):
        relocalize(one_database, crops)
    again = (
        "another version of mapfold made the map there; run `mapfold replay`, which makes it again"
    )
    with pytest.raises(ProjectionMismatch, match=again):
        tail(log, one_database, SETTINGS, once=True)
    with pytest.raises(ProjectionMismatch, match=again):
        check(log, one_database, SETTINGS)
    with psycopg.connect(one_database.vector_url, autocommit=True) as connection:
        connection.execute("COMMENT ON SCHEMA mapfold IS 'mapfold 2.12: of older rules'")
    with pytest.raises(ProjectionMismatch, match=again):
        tail(log, one_database, SETTINGS, once=True)
    status = projection_status(log, one_database, SETTINGS)
    assert [sink.condition for sink in status.sinks] == ["other", "other"]
    rebuild(log, one_database, SETTINGS)
    assert projection_status(log, one_database, SETTINGS).healthy
    assert relocalize(one_database, crops).places
    assert all(report.differing == 0 for report in check(log, one_database, SETTINGS))


@pytest.mark.slow
def test_two_round_trips_at_most(targets: Targets, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = 0
    execute = psycopg.Connection.execute

    def counted(*args: object, **kwargs: object) -> object:
        nonlocal sent
        sent += 1
        return execute(*args, **kwargs)  # type: ignore[arg-type]

    crops = next(questions())
    with CandidateReader(targets) as reader:
        monkeypatch.setattr(psycopg.Connection, "execute", counted)
        reader.candidates(crops)
    assert sent == (1 if targets.one_database else 2)


class TestCommand:
    """`mapfold relocalize` as a user runs it."""

    @pytest.fixture
    def question(self, tmp_path: Path) -> Path:
        file = tmp_path / "question.json"
        seen = next(d for d in walk(60, seed=3) if d["detections"])
        file.write_text(json.dumps(seen))
        return file

    def test_as_of_asks_the_log_alone(self, mapfold: Commands, log: Path, question: Path) -> None:
        said = mapfold("relocalize", question, "--log", log, "--as-of", "end", "--json")
        answer = said.json
        assert set(answer) >= {"places", "pose", "confidence"}
        assert set(answer["places"][0]) == {
            "place_id",
            "score",
            "centroid_x",
            "centroid_y",
            "evidence",
        }
        evidence = answer["places"][0]["evidence"][0]
        assert set(evidence) == {"det_id", "object_id", "class_name", "similarity"}
        assert set(answer["pose"]) == {"x", "y", "yaw", "spread_m"}
        assert 0.0 <= answer["known"] <= 1.0
        empty = mapfold("relocalize", question, "--log", log, "--as-of", "0", "--json")
        nothing = empty.json
        assert nothing["thin"] == "0 observations from 0 spots"
        assert "the map is thin, 0 observations from 0 spots: do not trust" in empty.err
        assert nothing["unknown"] is True
        assert nothing["places"] == []
        assert nothing["pose"] is None
        assert nothing["confidence"] == 0.0

    def test_settings_are_those_given_or_told_to_be_the_default(
        self, mapfold: Commands, log: Path, question: Path
    ) -> None:
        asked = ("relocalize", question, "--log", log, "--json")
        plain, given = mapfold(*asked), mapfold(*asked, "--set", "eps_m=20.0")
        assert len(given.json["places"]) < len(plain.json["places"])
        assert "default settings" in plain.err
        assert "default settings" not in given.err

    def test_classes_take_the_place_of_a_question(
        self, mapfold: Commands, log: Path, tmp_path: Path
    ) -> None:
        first, second = WEIRD[:2]
        asked = ("relocalize", "--log", log, "--json")
        said = mapfold(*asked, "--class", first, "--class", second).json
        assert {e["class_name"] for place in said["places"] for e in place["evidence"]} == {
            first,
            second,
        }
        file = tmp_path / "classes.json"
        file.write_text(json.dumps([{"class": first}, {"class": second}]))
        assert mapfold(*asked, file).json == said
        refused = mapfold("relocalize", "--log", log, "--class", "bakers rack", code=2)
        assert "similar ones: baker's rack" in refused.err

    def test_a_question_of_several_views(
        self, mapfold: Commands, log: Path, tmp_path: Path
    ) -> None:
        seen = [d["detections"] for d in walk(60, seed=3) if d["detections"]][:2]
        moved = {"dx": 0.25, "dy": 0.0, "dyaw": 0.5, "crops": seen[1]}
        file = tmp_path / "views.json"
        file.write_text(json.dumps({"views": [{"crops": seen[0]}, moved]}))
        assert mapfold("relocalize", file, "--log", log, "--json").json["pose"]
        file.write_text(json.dumps({"views": [{"crops": seen[0]}, {"crops": seen[1]}]}))
        refused = mapfold("relocalize", file, "--log", log, code=2)
        assert "views.1.dx: is missing" in refused.err

    def test_a_stream_of_questions_is_tracked(
        self, mapfold: Commands, log: Path, tmp_path: Path
    ) -> None:
        index, track = ExactIndex(view_of(log, SETTINGS)), Track("relocalize --track")
        lines, expected = [], []
        for number, document in enumerate(walk(14, seed=3)):
            if not document["detections"]:
                continue
            moved = {"dx": 0.25 * number, "dy": 0.0, "dyaw": 0.5}
            asked = {"crops": document["detections"], **moved}
            answer = rank(crops := read_question(asked).crops, index.search(crops))
            found = track.step(
                (0.25 * number, 0.0, 0.5),
                answer.hypotheses,
                answer.confidence,
                answer.known,
                answer.looks,
            )
            lines.append(json.dumps(asked))
            expected.append(answer.document() | {"track": found.document()})
        file = tmp_path / "questions.jsonl"
        file.write_text("\n\n".join(lines) + "\n")
        asked_log = ("relocalize", "--track", "--log", log)
        assert len(expected) > 5
        assert expected[-1]["track"]["questions"] == len(expected)
        assert [json.loads(line) for line in mapfold(*asked_log, file).out.splitlines()] == expected
        file.write_text("\n".join([lines[0], "nonsense", lines[1]]))
        said = mapfold(*asked_log, file, code=2)
        first, error, second = map(json.loads, said.out.splitlines())
        assert [first, second] == expected[:2]
        assert error["error"]["kind"] == "bad_question"
        assert "1 of 3 questions could not be answered" in said.err

    def test_plain_and_text(self, mapfold: Commands, log: Path, question: Path) -> None:
        said = mapfold("relocalize", question, "--log", log, "--as-of", "end", "--method", "plain")
        assert said.out.startswith("p")

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["--as-of", "end"], "--log"),
            (["--class", "cup"], "give either QUERY"),
            (["--track", "--class", "cup"], "--track reads questions"),
            (["--track", "--method", "plain"], "--track follows the poses"),
            (["--set", "eps_m=1.0"], "--log LOG"),
            (["--method", "magic"], "choose joint or plain"),
            (["--image", "big"], "--image"),
            (["--hfov", "0"], "field of view"),
            (["--as-of", "end", "--log", "nowhere"], "nowhere"),
        ],
        ids=lambda value: str(value)[:30],
    )
    def test_misuse_is_one_line(
        self, mapfold: Commands, question: Path, arguments: list[str], said: str
    ) -> None:
        refused = mapfold("relocalize", question, *arguments, code=2)
        assert said in refused.err
        assert len(refused.err.strip().splitlines()) == 1
