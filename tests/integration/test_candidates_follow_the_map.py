"""A reader that stays open has the candidates and constants of the map as it is now."""

from pathlib import Path
from typing import Any

import psycopg
import pytest

from eventsrc.envelope.commands import UseSettings
from projections.fold.map_errors import ProjectionMismatch, QuestionError
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, MapConstants, QuestionCrop, read_question
from projections.localize.relocalize import candidates as candidates_module
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader
from tests.support.flickering_house import flickering_house
from tests.support.logs import WEIRD, append_command, command, forget_keyframes, walk, write_log
from tests.support.scenes import assert_equal, view_under_commands
from tests.support.thorough import mostly_slow, rounds

MANY = 500
KNOWN = (QuestionCrop(None, None, "chair"), QuestionCrop(None, None, "oven"))


def settings_of(corrections: Any) -> Settings:
    return corrections.settings or Settings()


@pytest.fixture(scope="module")
def documents() -> list[dict[str, Any]]:
    return flickering_house("a", 200)


def questions() -> list[tuple[QuestionCrop, ...]]:
    asked = [read_question(d).crops for d in flickering_house("b", 40) if d["detections"]]
    return [*asked[:: rounds(9, 20)], KNOWN, (*asked[0], *KNOWN)]


def agree(log: Path, reader: CandidateReader) -> MapConstants:
    index = ExactIndex(view_under_commands(log))
    for crops in questions():
        assert_equal(reader.candidates(crops, MANY), index.search(crops, MANY))
    return index.constants


@pytest.mark.slow
def test_an_open_reader_follows_tail_and_refold(
    tmp_path: Path, documents: list[dict[str, Any]], targets: Targets
) -> None:
    log = tmp_path / "log"
    write_log(log, documents[:60])
    tail(log, targets, settings_of, once=True)
    with CandidateReader(targets) as reader:
        page = agree(log, reader)
        assert page.evidence.range_m == Settings().evidence.range_m
        given = {"fusion": "evidence", "camera": {"hfov_deg": 75.0}}
        append_command(log, command(UseSettings, settings=given))
        tail(log, targets, settings_of, once=True)
        assert agree(log, reader).camera.hfov_deg == 75.0
        write_log(log, documents[60:130])
        tail(log, targets, settings_of, once=True, batch_events=20)
        before = agree(log, reader)
        assert before.different != page.different
        given |= {
            "evidence": {"range_m": 1.25, "different": 0.6},
            "localizer": {"known_shift": 0.5, "known_count": 30},
        }
        append_command(log, command(UseSettings, settings=given))
        tail(log, targets, settings_of, once=True)
        now = agree(log, reader)
        assert (now.evidence.range_m, now.different) == (1.25, 0.6)
        assert now.localizer.known_shift == 0.5
        write_log(log, documents[130:])
        append_command(log, forget_keyframes(10, 40, run_id="sim-7-a"))
        tail(log, targets, settings_of, once=True)
        agree(log, reader)


@pytest.mark.slow
def test_a_sample_of_a_large_map_is_the_same_in_both(
    tmp_path: Path,
    documents: list[dict[str, Any]],
    targets: Targets,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("projections.localize.relocalize.constants.SAMPLED", 64)
    monkeypatch.setattr("projections.postgres.queries.candidate_rows.SAMPLED", 64)
    log = tmp_path / "log"
    with_new = []
    for start in range(0, 200, 50):
        write_log(log, documents[start : start + 50])
        tail(log, targets, settings_of, once=True)
        with CandidateReader(targets) as reader:
            with_new.append(agree(log, reader))
    assert len({constants.different for constants in with_new}) > 1


@pytest.mark.slow
def test_constants_are_sent_once(
    tmp_path: Path, documents: list[dict[str, Any]], targets: Targets
) -> None:
    log = write_log(tmp_path / "log", documents[:60])
    tail(log, targets, settings_of, once=True)
    with CandidateReader(targets) as reader:
        constants = [reader.candidates(crops).constants for crops in questions()]
    assert all(each is constants[0] for each in constants)


class TestClasses:
    """Crops of which only the class is known."""

    @pytest.fixture
    def log(self, tmp_path: Path, documents: list[dict[str, Any]]) -> Path:
        return write_log(tmp_path / "log", documents)

    @pytest.mark.parametrize(
        ("bound", "value"), mostly_slow([("OBJECTS_OF_A_CLASS", 2), ("MOST_OBJECTS", 5)])
    )
    def test_candidates_are_bounded_to_the_objects_seen_most(
        self,
        log: Path,
        targets: Targets,
        monkeypatch: pytest.MonkeyPatch,
        bound: str,
        value: int,
    ) -> None:
        monkeypatch.setattr(candidates_module, bound, value)
        for module in (candidates_module.__name__, "projections.postgres.queries.candidate_search"):
            monkeypatch.setattr(f"{module}.OBSERVATIONS_OF_EACH", 3)
        rebuild(log, targets, Settings())
        view = view_under_commands(log)
        with CandidateReader(targets) as reader:
            live = reader.candidates(KNOWN)
        assert_equal(live, ExactIndex(view).search(KNOWN))
        for crop, row in zip(KNOWN, live.matches, strict=True):
            assert {m.class_name for m in row} == {crop.class_name}
            assert {m.similarity for m in row} == {1.0}
            objects = {m.object_id for m in row}
            counts = {
                o.object_id: o.obs_count
                for o in view.objects.values()
                if o.class_name == crop.class_name
            }
            assert len(counts) > 2
            assert min(counts[o] for o in objects if o) >= sorted(counts.values())[-2]
            assert len(row) == sum(min(3, counts[o]) for o in objects if o)

    @pytest.mark.slow
    def test_one_crop_with_an_embedding_makes_unknown_classes_no_error(
        self, log: Path, targets: Targets
    ) -> None:
        rebuild(log, targets, Settings())
        crops = (questions()[0][0], QuestionCrop(None, None, "lmap"))
        with CandidateReader(targets) as reader:
            assert len(reader.candidates(crops).matches[0]) > 3
            assert reader.candidates(crops).matches[1] == ()

    @pytest.mark.parametrize(
        ("name", "said"),
        mostly_slow(
            [
                ("lmap", "no object of class 'lmap'; similar ones: lamp"),
                ('x" } --', r"there are .*chair, .*"),
                ("☕", r"there are .*chair, .*"),
            ]
        ),
    )
    def test_an_unknown_class_is_named_with_the_nearest(
        self, log: Path, targets: Targets, name: str, said: str
    ) -> None:
        rebuild(log, targets, Settings())
        asked = (QuestionCrop(None, None, "chair"), QuestionCrop(None, None, name))
        with (
            CandidateReader(targets) as reader,
            pytest.raises(QuestionError, match=said) as refused,
        ):
            reader.candidates(asked)
        with pytest.raises(QuestionError) as refused_here:
            ExactIndex(view_under_commands(log)).search(asked)
        assert str(refused.value) == str(refused_here.value)

    def test_odd_names_are_found(self, tmp_path: Path, targets: Targets) -> None:
        log = write_log(tmp_path / "odd", walk(60, seed=2))
        rebuild(log, targets, Settings())
        crops = tuple(QuestionCrop(None, None, name) for name in WEIRD)
        with CandidateReader(targets) as reader:
            live = reader.candidates(crops)
        assert all(live.matches)
        assert_equal(live, ExactIndex(view_under_commands(log)).search(crops))


def test_settings_of_another_version_are_refused(
    tmp_path: Path, documents: list[dict[str, Any]], one_database: Targets
) -> None:
    rebuild(write_log(tmp_path / "log", documents[:20]), one_database, Settings())
    with psycopg.connect(one_database.graph_url, autocommit=True) as connection:
        connection.execute("""UPDATE mapfold.checkpoint SET settings = '{"magic": 1}'""")
    with (
        CandidateReader(one_database) as reader,
        pytest.raises(ProjectionMismatch, match="run `mapfold replay`"),
    ):
        reader.candidates(questions()[0])
