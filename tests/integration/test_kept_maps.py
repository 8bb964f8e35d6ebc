"""Commands read the map after W events from the kept history, and its vectors from the log."""

import shutil
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from typer.testing import CliRunner

from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.store.history_recorder import map_after
from projections.surfaces.cli import command_line
from tests.integration.test_reembed import IN_B, A, run
from tests.property.test_timeline_cache import kept_early
from tests.support.logs import SAMPLE
from tests.support.models import drive, write

ASKED = [
    ("room", "LOG", "sim-7-a_p0"),
    ("export", "LOG", "--graphml", "map.graphml"),
    ("relocalize", "--class", "toilet", "--log", "LOG"),
    pytest.param(("draw", "LOG", "--out", "map.svg", "--merges"), marks=pytest.mark.slow),
    ("state", "LOG"),
]


def nothing_is_folded(*_: object) -> None:
    raise AssertionError("an event is folded")


@pytest.mark.parametrize("words", ASKED, ids=lambda words: words[0])
def test_a_kept_history_is_not_folded_again(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log = str(shutil.copytree(SAMPLE, tmp_path / "log"))
    ask = [log if word == "LOG" else word for word in words]
    program = command_line([words[0]])
    with kept_early():
        first = CliRunner().invoke(program, ask)
        with patch.object(SemanticMap, "fold", nothing_is_folded):
            again = CliRunner().invoke(program, ask)
    assert (first.exit_code, first.stdout) == (0, again.stdout), again.output


@pytest.mark.parametrize("rules", [Settings(), IN_B], ids=["recorded", "reembedded"])
@pytest.mark.parametrize("seed", [1, 2])
def test_vectors_read_from_the_log_are_those_of_the_fold(
    tmp_path: Path, rules: Settings, seed: int
) -> None:
    log = write(tmp_path / "log", drive(seed), A)
    run(log)
    with LogReader(log) as reader, kept_early():
        corrections = read_corrections(reader)
        for end in (reader.next_offset, Offset(reader.next_offset // 2)):
            folded = fold_log(reader, rules, end, corrections=corrections)[1]
            kept = map_after(reader, rules, end, corrections=corrections, embeddings=True)
            assert folded.embedded().tolist() == kept.embedded().tolist()
            asked = kept.embedded()[::-1]
            assert len(asked)
            assert np.array_equal(folded.vectors(asked), kept.vectors(asked))
            assert ExactIndex(kept).constants == ExactIndex(folded).constants
