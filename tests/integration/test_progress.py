"""Every command that may take long says how far it is, and a person at a terminal sees it.

`PROVOKED` and `WITHOUT` together name every command: a new one fails here until it is in one.
"""

import io
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from eventsrc.base.errors import MapfoldError
from eventsrc.base.progress import report_progress, reported, send_progress_to, working
from eventsrc.log import verify_log
from projections.surfaces.cli import COMMANDS, command_line, terminal
from projections.surfaces.cli.terminal import Bar, FileBars, ReadingBar, output_begins
from tests.docs.commands_page import commands
from tests.support.logs import append_command, name_place, walk, write_log

USAGE_ERROR: Any = typer.BadParameter.__base__
Report = tuple[str, int, int, str]

WITHOUT = {
    "demo": "says each step, a few seconds each",
    "record": "shows a status line",
    "router": "runs until Ctrl-C, reads nothing",
    "detect": "shows a status line",
    "spool": "reads no log",
    "import": "has a bar for each file",
    "ros": "follows the log until Ctrl-C",
    "foxglove": "has a bar of its own, then runs until Ctrl-C",
    "reembed": "has a bar of its own",
    "ui": "shows its progress in the page",
    "serve": "asks the databases, until Ctrl-C",
    "mcp": "answers agents, until the end of stdin or Ctrl-C",
    "status": "reads indexes only",
    "replay": "has a bar of its own",
    "tail": "has a bar of its own",
    "fleet replay": "has a bar of its own",
    "fleet status": "reads indexes only",
    "fleet verify": "has a bar of its own",
    "fleet relocalize": "asks the databases",
    "fleet align": "has a bar of its own",
    "fleet url": "reads no log",
    "db check": "tests/integration/test_db_check.py",
    "db url": "reads no log",
    "db start": "reads no log",
    "db stop": "reads no log",
    "db reset": "reads no log",
    "db roles": "reads no log",
    "log info": "reads indexes only",
    "log redact": "tests/integration/test_redact.py",
    "log archive": "tests/integration/test_archive.py",
    "log restore": "tests/integration/test_archive.py",
    "log retain": "tests/integration/test_archive.py",
    "completion": "reads no log",
    "help": "reads no log",
}
"""The commands that need no progress bar, or have one of their own, and why."""

EDITS = {
    "name-place": ["run-a:3", "hall"],
    "keep-apart": ["run-a:3", "run-a:9"],
    "undo-merge": ["7"],
    "join": ["run-a:3", "run-a:9"],
    "same-object": ["run-a_kf3_d0", "run-a_kf9_d0"],
    "different-objects": ["run-a_kf3_d0", "run-a_kf9_d0"],
    "drop-object": ["run-a_kf3_d0"],
    "drop-detection": ["run-a_kf3_d0"],
    "forget-run": ["run-a"],
    "forget-keyframes": ["run-a", "2..4"],
    "correct-poses": ["run-a", "--dx", "1"],
    "join-frames": ["b"],
    "relabel": ["cup=mug"],
    "use-settings": ["--set", "eps_m=1"],
    "undo": ["0"],
}
"""Arguments of the corrections. Some are refused: the log is read before."""

PROVOKED = {
    "simulate": ["--out", "drive.jsonl"],
    "state": ["L"],
    "draw": ["L", "--out", "map.png"],
    "find": ["L", "cups"],
    "export": ["L", "--dot", "map.dot"],
    "relocalize": ["--class", "cup", "--log", "L"],
    "evaluate": ["--map", "L", "--self"],
    "merges": ["L"],
    "why": ["L", "run-a:3", "run-a:9"],
    "diff": ["L", "3"],
    "changes": ["L"],
    "bisect": ["L", "place_count > 0"],
    "whatif": ["L", "--set", "eps_m=1"],
    "calibrate": ["L"],
    "edits": ["L", "--effects"],
    "log cat": ["L"],
    "log verify": ["L"],
    "log recover": ["L"],
    "log spaces": ["L"],
    "room": ["L", "hall"],
    "path": ["L", "hall", "0,0"],
    "align": ["L"],
} | {f"edit {kind}": ["L", kind, *given, "--dry-run"] for kind, given in EDITS.items()}

SLOW = {"simulate", "draw"}


def names() -> list[str]:
    """Every command, without the arguments of groups: ``edit undo``."""
    return [" ".join(w for w in name.split()[1:] if w != "LOG") for name, _ in commands()]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log L with a command in it."""
    log = write_log(tmp_path_factory.mktemp("progress") / "L", walk(30, detections=3))
    append_command(log, name_place(3, "hall"))
    return log


def reports_of(what: Callable[[], object]) -> list[Report]:
    """What is reported while something runs."""
    reports: list[Report] = []
    send_progress_to(lambda *report: reports.append(report))
    try:
        what()
    finally:
        send_progress_to(None)
    return reports


def run(arguments: list[str]) -> None:
    """Run a command in this process, whatever it exits with."""
    program: Any = typer.main.get_command(command_line([arguments[0]]))
    try:
        program(arguments, standalone_mode=False)
    except (MapfoldError, USAGE_ERROR):
        return


def test_each_command_is_looked_at() -> None:
    assert sorted([*PROVOKED, *WITHOUT]) == sorted(names())
    assert {name.split()[0] for name in names()} == set(COMMANDS)


@pytest.mark.seconds
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in PROVOKED]
)
def test_a_command_says_how_far_it_is(
    name: str, log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(log.parent)
    first = name.split()[0]
    words = [first] if first == "edit" else name.split()
    reports = reports_of(lambda: run([*words, *PROVOKED[name]]))
    begun = [each for each in reports if not 0 < each[2] <= each[1]]
    assert begun, capsys.readouterr().err
    assert reports[-1][1] >= reports[-1][2] > 0  # the last stage has ended


def test_verification_counts_up_to_the_end(log: Path) -> None:
    reports = reports_of(lambda: verify_log(log))
    done = [at / total for _, at, total, _ in reports]
    assert done == sorted(done)
    assert done[-1] == 1.0


def test_a_stage_ends_however_it_is_left() -> None:
    def stop_early() -> None:
        watched = reported(range(5), "counting", 5, "numbers")
        next(watched)
        watched.close()

    assert reports_of(stop_early) == [
        ("counting", 0, 5, "numbers"),
        ("counting", 5, 5, "numbers"),
    ]

    def fail() -> None:
        with pytest.raises(OSError, match="no"), working("trying"):
            raise OSError("no")

    assert reports_of(fail) == [("trying", 0, 0, ""), ("trying", 1, 1, "")]
    assert reports_of(lambda: list(reported([], "counting", 0, "numbers"))) == [
        ("counting", 1, 1, "numbers")
    ]


def test_a_stage_within_the_work_on_an_item_is_not_reported() -> None:
    """Many short ones would each end before a bar comes, as the reading of a log for each run."""

    def nested() -> None:
        for _ in reported(range(2), "mapping each run", 2, "runs"):
            list(reported(range(9), "reading the log", 9, "events"))
        report_progress("aligning", 1, 2)

    runs = [("mapping each run", done, 2, "runs") for done in (0, 1, 2)]
    assert reports_of(nested) == [*runs, ("aligning", 1, 2, "events")]


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[io.StringIO]:
    """What a terminal gets, with a bar that does not wait."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=100, markup=False)
    monkeypatch.setattr(terminal, "people", console)
    monkeypatch.setattr(terminal, "people", console)
    yield text
    send_progress_to(None)


def begin(bar: ReadingBar) -> None:
    """Report the begin of a stage and wait until its bar is there, if it is to come."""
    report_progress("reading the log", 10, 100)
    if bar._timer is not None:
        bar._timer.join()
    report_progress("reading the log", 20, 100)


def test_a_stage_that_takes_long_gets_a_bar(screen: io.StringIO) -> None:
    with ReadingBar(0.0) as bar:
        begin(bar)
        assert bar._bar is not None
        report_progress("reading the log", 100, 100)
        assert bar._bar is None
    assert "reading the log" in screen.getvalue()
    assert "/100" in screen.getvalue()
    report_progress("reading the log", 10, 100)  # dropped: no function is set
    assert bar._timer is None


def test_a_short_stage_gets_none(screen: io.StringIO) -> None:
    with ReadingBar(60.0):
        report_progress("reading the log", 10, 100)
        report_progress("reading the log", 100, 100)
    assert screen.getvalue() == ""


def test_a_stage_of_unknown_length_is_shown(screen: io.StringIO) -> None:
    with ReadingBar(0.0) as bar, working("drawing"):
        assert bar._timer is not None
        bar._timer.join()
    assert "drawing" in screen.getvalue()


@pytest.mark.parametrize("own", [Bar, FileBars])
def test_a_bar_of_the_command_takes_its_place(
    own: Callable[[], Bar | FileBars], screen: io.StringIO
) -> None:
    with ReadingBar(0.0) as bar:
        begin(bar)
        with own():
            assert bar._bar is None
            begin(bar)
            assert bar._timer is bar._bar is None
        begin(bar)
        assert bar._bar is not None


def test_data_on_stdout_removes_it_for_good(
    screen: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ReadingBar(0.0) as bar:
        monkeypatch.setattr(terminal, "_is_file", lambda _: True)
        begin(bar)
        output_begins()
        assert bar._bar is not None
        monkeypatch.setattr(terminal, "_is_file", lambda _: False)
        output_begins()
        begin(bar)
        assert bar._timer is bar._bar is None


def test_what_a_server_reads_is_not_shown(screen: io.StringIO) -> None:
    with ReadingBar(0.0) as bar:
        thread = threading.Thread(target=lambda: report_progress("reading the log", 10, 100))
        thread.start()
        thread.join()
        assert bar._timer is None


def test_nothing_is_told_without_a_terminal(
    screen: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "people", Console(file=screen))
    with ReadingBar(0.0) as bar:
        begin(bar)
        assert bar._timer is bar._bar is None
    assert screen.getvalue() == ""


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "TTY_COMPATIBLE"])
def test_no_variable_puts_a_bar_into_a_file(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "1")
    with (tmp_path / "said").open("w+") as said, monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", said)
        with ReadingBar(0.0) as bar, Bar() as own:
            begin(bar)
            own.show("reading the log", 10, 100)
        terminal.say("done")
        said.seek(0)
        assert said.read() == "done\n"
