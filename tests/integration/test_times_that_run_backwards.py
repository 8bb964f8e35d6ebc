"""Wherever a command takes a time, a log whose stamps run backwards is told of, on stderr."""

import ast
import json
from pathlib import Path

import pytest

import projections.surfaces.cli
from projections.postgres.connection import Targets
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.thorough import mostly_slow
from tests.support.walks import write_log

THEN = "2026-03-24T13:00:02Z"
"""The second keyframe of the run that was imported last; three of a later time lie before it."""
WARNING = f"log: of the 5 events up to {THEN}, 3 are stamped later: stamps run backwards"


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    """Beside a log of a later run with an earlier one behind it, and a question."""
    cup = detection("cup", [1.0, 0.0])
    later = [envelope(n, 0.0, run_id="run-b", detections=[cup]) for n in (101, 102, 103)]
    earlier = [envelope(n, 0.0, run_id="run-a", detections=[cup]) for n in (1, 2, 3)]
    write_log(tmp_path / "log", [*later, *earlier])
    (tmp_path / "question.json").write_text(json.dumps(later[0]))
    (tmp_path / "truth.jsonl").write_text("")
    return Commands.in_folder(tmp_path)


ASKED: list[tuple[str, ...]] = [
    ("state", "log", "--at", THEN),
    ("diff", "log", THEN),
    ("bisect", "log", "place_count > 0", "--to", THEN),
    ("relocalize", "question.json", "--log", "log", "--as-of", THEN),
    ("room", "log", "run-b_p0", "--at", THEN),
    ("draw", "log", "--at", THEN, "--out", "map.svg"),
    ("merges", "log", "--at", THEN),
    ("why", "log", "run-b_p0", "--at", THEN),
    ("diff", "log", "0", THEN),
    ("bisect", "log", "place_count > 0", "--from", THEN),
    ("whatif", "log", "--set", "eps_m=1", "--at", THEN),
    ("evaluate", "--map", "log", "--at", THEN),
    ("find", "log", "cup", "--near", "run-b_p0", "--at", THEN),
    ("path", "log", "run-b_p0", "0,0", "--at", THEN),
]


@pytest.mark.parametrize(
    "args",
    mostly_slow([(args,) for args in ASKED], 5),
    ids=[" ".join(args[:2]) for args in ASKED],
)
def test_stamps_that_run_backwards_are_reported_on_stderr(
    mapfold: Commands, args: tuple[str, ...]
) -> None:
    said = mapfold(*args)
    assert [line for line in said.err.splitlines() if line.startswith(WARNING)]
    assert "backwards" not in said.out
    to_an_offset = mapfold(*("5" if arg == THEN else arg for arg in args))
    assert "backwards" not in to_an_offset.err
    assert to_an_offset.out == said.out


def test_a_replay_tells_it_too(mapfold: Commands, one_database: Targets) -> None:
    said = mapfold("replay", "log", "--until", THEN, "--db", one_database.graph_url)
    assert said.err.startswith(WARNING)
    assert "log: 5 events, " in said.err


def test_no_command_takes_a_point_of_a_log_in_its_own_way() -> None:
    """One function does, which tells; a command with another would forget to."""
    modules = list(Path(projections.surfaces.cli.__file__).parent.glob("*.py"))
    taking = {
        module.name
        for module in modules
        for node in ast.walk(ast.parse(module.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module == "eventsrc.log.seek"
    }
    # `log cat` and `log restore` take a range of events, `log redact` compares the time of each.
    assert taking == {"folded_log.py", "log.py", "archive_command.py", "redact_command.py"}
