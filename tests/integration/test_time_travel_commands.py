"""The commands merges, why, diff, bisect and whatif: streams, exit codes, JSON."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from projections.fold.semantic_map import SemanticMap
from projections.surfaces.cli import main
from tests.support.commands import Commands, Said
from tests.support.envelopes import detection, envelope
from tests.support.thorough import mostly_slow, rounds
from tests.support.walks import write_damaged_log, write_log

RULES = ("--set", "eps_m=1.0", "--set", "min_samples=3")
XS = (0.0, 1.0, 2.0, 6.0, 5.0, 4.0, 9.0, 3.0)
"""Two places of three keyframes, one keyframe of noise, and one between the places."""


class InProcess:
    """Runs commands as `Commands` does, but in this process."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capfd = capfd

    def __call__(self, *args: str | Path, code: int = 0) -> Said:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            patch.setattr("sys.argv", ["mapfold", *map(str, args)])
            # The program sets it, and the tests fork no program of another environment.
            patch.setenv("OPENBLAS_NUM_THREADS", os.environ.get("OPENBLAS_NUM_THREADS", "1"))
            for stream in ("stdout", "stderr"):  # a program makes its own of them; give them back
                patch.setattr(sys, stream, getattr(sys, stream))
            try:
                main()
                left: object = 0
            except SystemExit as error:
                left = error.code or 0
        out, err = self._capfd.readouterr()
        assert left == code, f"exit {left}: {err or out}"
        return Said(code, out, err)


def make_log(folder: Path) -> None:
    cup = detection("cup", [1.0, 0.0])
    documents = [envelope(n, x, detections=[cup] * (n == 5)) for n, x in enumerate(XS, start=1)]
    write_log(folder / "log", documents)


@pytest.fixture
def mapfold(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> InProcess:
    """Commands beside a log whose keyframe 8, at offset 7, makes two places one."""
    make_log(tmp_path)
    return InProcess(tmp_path, capfd)


def test_in_a_process_of_its_own(tmp_path: Path) -> None:
    make_log(tmp_path)
    program = Commands.in_folder(tmp_path)
    assert len(program("merges", "log", *RULES, "--json").json) == 1
    said = program("why", "log", "run-a_p9", code=2).err
    assert said.startswith("mapfold: no place or object 'run-a_p9'")


def test_merges(mapfold: InProcess) -> None:
    said = mapfold("merges", "log", *RULES)
    assert said.out.splitlines()[1].split() == [
        *("1", "7", "2026-03-24T13:00:08.000Z", "run-a:8", "p0", "p1"),
        *("3", "+", "3", "1", "1"),
    ]
    (merge,) = mapfold("merges", "log", *RULES, "--json").json
    assert (merge["offset"], merge["run_id"], merge["keyframe_id"]) == (7, "run-a", 8)
    assert merge["time"] == "2026-03-24T13:00:08.000Z"
    assert (merge["survivor"], merge["absorbed"]) == ("run-a_p0", ["run-a_p1"])
    assert mapfold("merges", "log", *RULES, "--at", "7", "--json").json == []
    assert mapfold("merges", "log", *RULES, "--at", "7").out == (
        "no merges: 7 events formed 2 places\n"
    )


def test_a_merge_shows_in_state_from_the_next_offset_on(mapfold: InProcess) -> None:
    (merge,) = mapfold("merges", "log", *RULES, "--json").json
    for at, places in ((merge["offset"], 2), (merge["offset"] + 1, 1)):
        state = mapfold("state", "log", *RULES, "--at", str(at), "--json").json
        assert len(state["places"]) == places


@pytest.mark.parametrize("suffix", mostly_slow(["png", "svg"]))
def test_a_merge_is_drawn(mapfold: InProcess, suffix: str) -> None:
    said = mapfold("merges", "log", *RULES, "--draw", "1", "--out", f"merge.{suffix}")
    assert said.err == f"wrote merge.{suffix}: merge 1, before and after\n"
    drawn = (mapfold.folder / f"merge.{suffix}").read_bytes()
    assert drawn.startswith(b"\x89PNG" if suffix == "png" else b"<?xml")
    mapfold("merges", "log", *RULES, "--draw", "1", "--out", f"again.{suffix}")
    assert (mapfold.folder / f"again.{suffix}").read_bytes() == drawn


def test_why(mapfold: InProcess) -> None:
    said = mapfold("why", "log", "run-a_p1", *RULES)
    assert said.out.startswith("place p1: absorbed by p0 at offset 7 (2026-03-24T")
    story = mapfold("why", "log", "run-a_p1", *RULES, "--json").json
    assert story["stands"] is False
    assert [entry["what"] for entry in story["entries"]] == ["founded", "ended"]
    assert mapfold("why", "log", "run-a_p1", "--at", "7", *RULES, "--json").json["stands"] is True


def test_why_same(mapfold: InProcess) -> None:
    said = mapfold("why", "log", "--same", "run-a:1", "run-a:4", *RULES)
    assert said.out.startswith("run-a:1 and run-a:4: in one place since offset 7 (run-a:8, ")
    story = mapfold("why", "log", "--same", "run-a:1", "run-a:7", *RULES, "--json").json
    assert (story["same"], story["since"]) == (False, None)


def test_diff(mapfold: InProcess) -> None:
    said = mapfold("diff", "log", "7", "8", *RULES)
    assert "  - p1 (3 keyframes) into p0 at 7 (run-a:8)" in said.out.splitlines()
    diff = mapfold("diff", "log", "run-a:7", "end", *RULES, "--json").json
    assert (diff["from"], diff["to"], diff["same"]) == (7, 8, False)
    assert diff["places"]["gone"][0]["into"] == "run-a_p0"
    states = [mapfold("state", "log", *RULES, "--at", at, "--digest").out for at in ("7", "8")]
    assert diff["digests"] == [digest.strip() for digest in states]
    assert mapfold("diff", "log", "5", "5").out.startswith("the same map at 5 and 5: digest ")


def test_bisect(mapfold: InProcess) -> None:
    said = mapfold("bisect", "log", "merged('run-a_p1')", *RULES)
    assert said.out.startswith("became true at offset 7 (run-a:8, ")
    found = mapfold("bisect", "log", "place_count < 2", "--scan", "--json", *RULES).json
    assert found["found"]["offset"] == 7
    assert [(turn["offset"], turn["becomes"]) for turn in found["turns"]] == [(5, False), (7, True)]
    assert mapfold("bisect", "log", "place_count > 9", *RULES).out == (
        "never true from --at 0 to 8\n  place_count: 1 at the end\n"
    )
    assert mapfold("bisect", "log", "place_count < 9", *RULES).out == (
        "true all along from --at 0 to 8\n  place_count: 1 at the end\n"
    )
    assert mapfold("bisect", "log", "place_count == 0", *RULES).out.splitlines()[0] == (
        "true at --at 0, then false; it does not become true again from --at 0 to 8"
    )


def test_bisect_points_at_what_it_cannot_read(mapfold: InProcess) -> None:
    said = mapfold("bisect", "log", "place_count < 2 and plac > 1", code=2)
    expression, caret, message = said.err.splitlines()
    assert expression[caret.index("^") :] == "plac > 1"
    assert message == "mapfold: expression, column 21: no function 'plac'; did you mean 'place_of'?"
    assert said.out == ""


def test_whatif(mapfold: InProcess) -> None:
    said = mapfold("whatif", "log", "--base", "eps_m=1", "--set", "eps_m=0.5")
    assert said.out.splitlines()[0].split()[:3] == ["settings", "places", "noise"]
    assert said.out.splitlines()[2].split()[:4] == ["eps_m=0.5", "0", "8", "0"]
    found = mapfold("whatif", "log", "--grid", "eps_m=1,1.5", "--json").json
    assert [each["set"] for each in found["alternatives"]] == [{"eps_m": 1.0}, {}]
    assert found["alternatives"][1]["same"] is True
    assert found["alternatives"][1]["places_part_at"] is None


@pytest.mark.slow
def test_whatif_in_several_processes_prints_the_same(mapfold: InProcess) -> None:
    asked = ("whatif", "log", "--grid", "eps_m=0.5,1", "--grid", "min_samples=2,3", "--json")
    several = str(rounds(3, 2))
    documents = [mapfold(*asked, "--processes", count).json for count in ("1", several)]
    for document in documents:
        for each in [document["base"], *document["alternatives"]]:
            del each["fold_seconds"]
    assert documents[0] == documents[1]


def test_whatif_with_truth_and_picture(mapfold: InProcess) -> None:
    truth = mapfold.folder / "truth.jsonl"
    lines = [
        {"run_id": "run-a", "keyframe_id": n, "room": "a" if x < 3 else "b", "instances": []}
        for n, x in enumerate(XS, start=1)
    ]
    truth.write_text("".join(json.dumps(line) + "\n" for line in lines))
    said = mapfold(
        *("whatif", "log", "--base", "eps_m=1", "--try", "min_samples=4"),
        *("--truth", truth, "--picture", "maps.png", "--json"),
    )
    assert said.json["base"]["truth"]["places"]["v_measure"] < 1.0
    assert (mapfold.folder / "maps.png").read_bytes().startswith(b"\x89PNG")
    assert said.err.endswith("wrote maps.png: 2 maps\n")


@pytest.mark.parametrize(
    "args", [("whatif", "log", "--try", "eps_m=1"), ("evaluate", "--map", "log")]
)
def test_truth_of_another_log_scores_nothing(mapfold: InProcess, args: tuple[str, ...]) -> None:
    truth = mapfold.folder / "other.jsonl"
    line = {"run_id": "run-z", "keyframe_id": 1, "room": "a", "instances": ["cup-1"]}
    truth.write_text(json.dumps(line))
    said = mapfold(*args, "--truth", truth)
    assert said.err.startswith("no truth for any keyframe of log: its places and objects are not")
    if args[0] == "whatif":
        assert [row.split()[-2:] for row in said.out.splitlines()[1:3]] == [["-", "-"]] * 2
    truth.write_text(json.dumps({**line, "run_id": "run-a"}))
    assert mapfold(*args, "--truth", truth).err == ""


@pytest.mark.parametrize("processes", mostly_slow(["1", "2"]))
def test_whatif_draws_what_it_has_folded(
    mapfold: InProcess, monkeypatch: pytest.MonkeyPatch, processes: str
) -> None:
    folded = 0
    fold = SemanticMap.fold

    def counting(self: SemanticMap, *args: Any) -> Any:
        nonlocal folded
        folded += 1
        return fold(self, *args)

    monkeypatch.setattr(SemanticMap, "fold", counting)
    asked = ("whatif", "log", "--base", "eps_m=1", "--try", "min_samples=2")
    mapfold(*asked, "--picture", f"{processes}.svg", "--processes", processes)
    assert folded == (2 * len(XS) if processes == "1" else 0)  # the others fold elsewhere
    drawn = (mapfold.folder / f"{processes}.svg").read_text("utf-8")
    assert drawn.count(">p0<") == 2
    assert "min_samples=2: 1 place, 1 noise" in drawn


@pytest.mark.parametrize(
    "args",
    [
        ("draw", "log", "--out", "m.gif"),
        ("merges", "log", "--draw", "1", "--out", "m.gif"),
        ("whatif", "log", "--try", "eps_m=1", "--picture", "m.gif"),
        ("evaluate", "--map", "log", "--picture", "m.gif"),
    ],
    ids=lambda args: args[0],
)
def test_a_wrong_picture_name_is_an_error_before_the_fold(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], args: tuple[str, ...]
) -> None:
    write_damaged_log(tmp_path / "log", [envelope(1)])  # who folds it first meets that instead
    said = InProcess(tmp_path, capfd)(*args, code=2)
    assert said.err == "mapfold: m.gif: a picture is .png, .svg or .pdf; give such a name\n"


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("merges", "log", "--out", "m.png"), "--out m.png is for the picture of --draw N"),
        (("merges", "nolog"), "no log at nolog"),
        (("merges", "log", "--at", "99"), "99 is beyond the end"),
        (("merges", "log", "--at", "3", "--show", "1"), "no merge number 1; there are none"),
        (("merges", "log", *RULES, "--draw", "2"), "no merge number 2; there are 1 to 1"),
        (("merges", "log", *RULES, "--draw", "1", "--out", "m.gif"), "m.gif: a picture is .png"),
        (("why", "log"), "give a place, an object, or two"),
        (("why", "log", "run-a_p0", "--same", "a:1", "a:2"), "give a place, an object, or two"),
        (("why", "log", "run-a_p7", *RULES), "near it: p1, p0; "),
        (("why", "log", "--same", "run-a:1", "run-a:99"), "near it: run-a:8, run-a:7"),
        (("diff", "log", "run-z:1", "end"), "run-z:1: log has no such keyframe"),
        (("bisect", "log", "merged('run-a_p9')", *RULES), "column 8: no place 'run-a_p9'"),
        (
            ("bisect", "log", "place_count > 0", "--from", "5", "--to", "3"),
            "the start (5) is after the end (3)",
        ),
        (("whatif", "log"), "nothing to try"),
        (("whatif", "log", "--set", "eps=1"), "no setting 'eps'"),
        (("whatif", "log", "--set", "eps_m=1", "--truth", "none.jsonl"), "--truth none.jsonl"),
    ],
)
def test_misuse_is_one_line(mapfold: InProcess, args: tuple[str, ...], says: str) -> None:
    said = mapfold(*args, code=2)
    assert says in said.err.splitlines()[-1]
    assert said.err.splitlines()[-1].startswith("mapfold: ")
    assert said.out == ""


@pytest.mark.parametrize(
    "args",
    mostly_slow(
        [
            (("merges",),),
            (("whatif", "--try", "eps_m=1"),),
            (("whatif", "--try", "eps_m=1", "--processes", "2"),),
        ],
        2,
    ),
)
def test_an_event_that_cannot_be_folded_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], args: tuple[str, ...]
) -> None:
    write_damaged_log(tmp_path / "log", [envelope(1), envelope(2)])
    said = InProcess(tmp_path, capfd)(args[0], "log", *args[1:], code=1)
    assert said.err.startswith("mapfold: event at offset 2 cannot be folded: not JSON")
    assert len(said.err.splitlines()) == 1


@pytest.fixture
def corrected(mapfold: InProcess) -> InProcess:
    """The same log, with commands: its settings (offset 8), that its merge is undone (9), and the
    second place's name (10)."""
    said = ("--issued-by", "ann@lab", "--reason", "a door")
    for number, command in enumerate(
        (("use-settings", *RULES), ("undo-merge", "7"), ("name-place", "run-a_p1", "kitchen"))
    ):
        mapfold("edit", "log", *command, *said, "--command-id", f"c{number}")
    return mapfold


def test_every_command_takes_what_is_known_where_its_map_ends(corrected: InProcess) -> None:
    def places(*known: str) -> int:
        return int(
            corrected("state", "log", "--at", "8", *known, "--json").json["counts"]["places"]
        )

    assert [places(*RULES), places(*RULES, "--known-at", "end")] == [1, 2]
    assert places("--known-at", "10") == places("--known-at", "11") == 2
    document = corrected("state", "log", "--json").json
    assert [p.get("name") for p in document["places"]] == [None, "kitchen"]
    assert document["corrections"]["known_at"] == 11
    assert [c["command_id"] for c in document["corrections"]["commands"]] == ["c0", "c1", "c2"]
    assert len(corrected("merges", "log", "--json").json) == 0
    assert len(corrected("merges", "log", "--known-at", "9", "--json").json) == 1
    assert len(corrected("merges", "log", "--at", "9", "--json").json) == 1
    (refused,) = corrected("merges", "log", "--refused", "--json").json
    assert refused["command"]["command_id"] == "c1"
    assert corrected("merges", "log", "--refused", "--at", "7", "--json").json == []
    assert corrected("merges", "log", "--objects", "--json").json == []
    assert corrected("why", "log", "kitchen", "--json").json["subject"] == "run-a_p1"
    assert "no place" in corrected("why", "log", "kitchen", "--known-at", "9", code=2).err
    same = corrected("why", "log", "run-a:1", "run-a:4", "--json").json
    assert same == corrected("why", "log", "--same", "run-a:1", "run-a:4", "--json").json
    assert [same["same"], same["entries"][-1]["command"]["command_id"]] == [False, "c1"]
    early = corrected("why", "log", "run-a:1", "run-a:4", "--known-at", "9", "--json").json
    assert early["same"]
    turned = corrected("bisect", "log", "named('kitchen')", "--json").json
    assert turned["found"]["offset"] == 5
    diff = corrected("diff", "log", "9", "11", "--json").json
    assert [c["command_id"] for c in diff["commands"]] == ["c1", "c2"]
    assert corrected("diff", "log", "9", "11", "--known-at", "11", "--json").json["same"]
    whatif = corrected("whatif", "log", "--without", "c1", "--without", "c0", "--json").json
    assert whatif["settings"]["eps_m"] == 1.0
    first, second = whatif["alternatives"]
    assert first["places"] == 1
    assert second["set"]["eps_m"] == 1.5
    early = corrected("whatif", "log", "--set", "eps_m=1.1", "--known-at", "9", "--json").json
    assert early["base"]["places"] == 1
    corrected("draw", "log", "--known-at", "9", "--out", "map.png")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("whatif", "log", "--without", "c7"), "no command 'c7' in this log; near it: c2, c1, c0"),
        (("merges", "log", "--refused", "--objects"), "tables of their own; give one alone"),
        (("merges", "log", "--refused", "--show", "1"), "tables of their own; give one alone"),
        (("merges", "log", "--known-at", "12"), "12 is beyond the end of log"),
        (("why", "log", "run-a:1", "run-a:99"), "no keyframe 'run-a:99' in this log"),
        (("bisect", "log", "named('kitchn')"), "no name 'kitchn' in this log; near it: kitchen"),
    ],
)
def test_what_is_not_there_is_named(
    corrected: InProcess, arguments: tuple[str, ...], says: str
) -> None:
    assert says in corrected(*arguments, code=2).err
