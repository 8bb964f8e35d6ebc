"""`evaluate --workers`: the scores are those of one process, for any number of them."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.ingest import Accepted
from projections.fold.map_errors import QuestionError
from projections.fold.settings import Settings
from projections.localize.evaluate import parallel
from projections.localize.evaluate.evaluation import evaluate
from projections.localize.evaluate.truth import read_truth
from projections.surfaces.cli.evaluate import CameraOptions, FoldSettings
from projections.surfaces.cli.evaluate import evaluate as command
from tests.integration.test_evaluate_command import save
from tests.support.buildings import Building, Keyframe, drive
from tests.support.commands import Commands
from tests.support.thorough import THOROUGH, rounds

EVIDENCE = Settings(fusion="evidence", places="rooms")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs ``a``, ``b`` of a building and ``x`` of another, with truth."""
    found = tmp_path_factory.mktemp("workers")
    building, stranger = Building(31, things=40), Building(32, things=40)
    save(found, "a", drive(building, "a", 1, rounds(50, 20)))
    save(found, "b", drive(building, "b", 2, rounds(12, 4)))
    save(found, "x", drive(stranger, "x", 3, rounds(12, 4)))
    return found


@pytest.fixture(autouse=True)
def used(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Has few questions shared out, by processes that have started. How many answered."""
    found: list[int] = []
    start = parallel._start

    def ready(calls: Sequence[Any], count: int, stack: Any) -> list[Any]:
        processes = start(calls, count, stack)
        for number, process in enumerate(processes):
            process.give(number)
        found.append(sum(process.has_answer(60) for process in processes))
        return processes

    monkeypatch.setattr(parallel, "CALLS_PER_WORKER", 4)
    monkeypatch.setattr(parallel, "_start", ready)
    return found


def scored(folder: Path, workers: int | None, **options: Any) -> str:
    """The scores but for latencies, as JSON."""
    truth = read_truth(folder / f"{name}.truth.jsonl.gz" for name in "abx")
    found = evaluate(
        folder / "a",
        [folder / "b", folder / "x"],
        truth,
        options.pop("settings", Settings()),
        own=True,
        workers=workers,
        **options,
    )
    return without_latencies(found.scores)


def without_latencies(scores: dict[str, Any]) -> str:
    for column in (*scores["relocalization"].values(), *scores["views"].values()):
        del column["latency_ms"]
    return json.dumps(scores)


@pytest.mark.seconds
@pytest.mark.parametrize(
    "options",
    [
        {"settings": EVIDENCE},
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"method": "plain", "seed": 3, "until": "40"}, marks=pytest.mark.slow),
    ],
)
def test_scores_are_those_of_one_process(
    folder: Path, used: list[int], options: dict[str, Any]
) -> None:
    alone = scored(folder, 0, **options)
    assert set(used) == {0}
    for workers in (1, 2, 3, 5) if THOROUGH else (1,):
        used.clear()
        assert scored(folder, workers, **options) == alone
        assert max(used) == workers


def test_a_question_in_another_space_is_refused_alike(folder: Path) -> None:
    for name, dimension in (("y", 8), ("z", 16)):
        run = [_cut(keyframe, dimension) for keyframe in drive(Building(33), name, 4, 20)]
        save(folder, name, run)
    queries = [folder / name for name in "byz"]
    truth = read_truth(folder / f"{name}.truth.jsonl.gz" for name in "abyz")
    for workers in (0, 2):
        with pytest.raises(QuestionError, match="question's embeddings have 8 dimensions"):
            evaluate(folder / "a", queries, truth, Settings(), workers=workers)


def _cut(keyframe: Keyframe, dimension: int) -> Keyframe:
    accepted = keyframe.accepted
    vectors = tuple(None if v is None else v[:dimension] for v in accepted.vectors)
    cut = Accepted(accepted.envelope, accepted.det_ids, vectors)
    return replace(keyframe, accepted=cut)


@pytest.mark.seconds
@pytest.mark.slow
@pytest.mark.parametrize(("self_", "many"), [(False, 1), (True, 2)])
def test_scores_of_several_maps_are_those_of_one_process(
    folder: Path, used: list[int], capsys: pytest.CaptureFixture[str], self_: bool, many: int
) -> None:
    found = []
    for workers in (0, many):
        command(
            map_logs=[folder / "a", folder / "x"],
            query_logs=[folder / "b"],
            truth_files=[folder / f"{name}.truth.jsonl.gz" for name in "abx"],
            camera=CameraOptions(),
            self_=self_,
            chosen=FoldSettings(),
            workers=workers,
            json_=True,
        )
        assert max(used) == workers
        scores = json.loads(capsys.readouterr().out)
        found.append((scores["worst"], *map(without_latencies, scores["maps"])))
    assert found[0] == found[1]
    assert len(found[0]) == 3


def test_a_number_of_workers_below_0_is_misuse(folder: Path) -> None:
    arguments = ["evaluate", "--map", "a", "--self", "--workers", "-1"]
    assert "--workers" in Commands.in_folder(folder)(*arguments, code=2).err
