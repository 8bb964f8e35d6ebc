"""Ctrl-C, closed pipes, full disks, closed streams and --version, for any command."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest

from projections.surfaces.cli.program import EXIT_INTERRUPTED, EXIT_READER_GONE
from tests.docs.console import ROOT
from tests.support import prefork
from tests.support.commands import TIMEOUT_S, Commands
from tests.support.logs import walk
from tests.support.walks import write_damaged_log, write_log

_CTRL_C_AT_IMPORT = """
import _signal, sys  # nothing that loads what the program loads
module = sys.argv.pop(1)

class CtrlC:
    def find_spec(self, name, path, target=None):
        if name == module:
            _signal.raise_signal(_signal.SIGINT)

sys.meta_path.insert(0, CtrlC())
from projections.surfaces.cli import main
main()
"""
_CTRL_C_IN_A_WORKER = """
import os, signal, sys
if any("worker_process" in word for word in sys.orig_argv):
    os.kill(os.getpid(), signal.SIGINT)
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("written") / "log", walk(500))


@pytest.fixture
def mapfold(tmp_path: Path, written: Path) -> Commands:
    shutil.copytree(written, tmp_path / "log")
    return Commands.in_folder(tmp_path)


@pytest.mark.parametrize(
    ("module", "args"),
    [
        ("contextlib", ("log", "info", "log")),  # the first thing that is imported
        ("projections.surfaces.demo", ("demo",)),  # imported when the command runs already
        pytest.param("projections.surfaces.cli.maps", ("state", "log"), marks=pytest.mark.slow),
        pytest.param(
            "projections.surfaces.cli.program", ("log", "info", "log"), marks=pytest.mark.slow
        ),
        pytest.param("typer", ("state", "log"), marks=pytest.mark.slow),
        pytest.param("numpy", ("state", "log"), marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_is_one_line_and_130(tmp_path: Path, module: str, args: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CTRL_C_AT_IMPORT, module, *args],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, "mapfold: interrupted\n")


_CTRL_C_TWICE = """
import signal
from projections.surfaces.cli import program
say = program.say
def interrupted(line):
    signal.raise_signal(signal.SIGINT)
    say(line)
def app():
    raise KeyboardInterrupt
program.say = interrupted
signal.signal(signal.SIGINT, signal.default_int_handler)
program.run_app(app)
"""


def test_a_second_ctrl_c_while_the_first_is_reported_is_one_line_too() -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
    done = prefork.run(_CTRL_C_TWICE, ["-c"], env=env, cwd=ROOT, timeout=TIMEOUT_S)
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, b"mapfold: interrupted\n")


@pytest.mark.slow
def test_ctrl_c_in_a_starting_worker_is_one_line(mapfold: Commands) -> None:
    (mapfold.folder / "sitecustomize.py").write_text(_CTRL_C_IN_A_WORKER)
    env = {**mapfold.env, "PYTHONPATH": str(mapfold.folder)}
    said = Commands(mapfold.folder, env)(
        "whatif", "log", "--grid", "eps_m=1.0,2.0", "--processes", "2", code=1
    )
    (line,) = said.err.splitlines()
    assert "a process that folds it died or did not start: " in line
    assert "KeyboardInterrupt" in line


def _into_closed_pipe(mapfold: Commands, *args: str, stream: str = "stdout") -> tuple[int, str]:
    """Exit code and the other stream of a command whose ``stream`` is closed at the reading end."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    env = {k: v for k, v in mapfold.env.items() if k != "PYTHONUNBUFFERED"}
    streams = {"stdout": write_end, "stderr": write_end}
    with tempfile.TemporaryFile() as other:
        streams["stderr" if stream == "stdout" else "stdout"] = other.fileno()
        process = Commands(mapfold.folder, env).start(*args, **streams)
        os.close(write_end)
        code = process.wait(TIMEOUT_S)
        other.seek(0)
        return code, other.read().decode()


@pytest.mark.parametrize(
    ("args", "code"),
    [
        (("state", "log", "--digest"), 0),  # little: the command is done before anything is written
        (("--help",), EXIT_READER_GONE),
        (("log", "cat", "log", "--json"), EXIT_READER_GONE),
    ],
)
def test_a_closed_pipe_is_exit_141(mapfold: Commands, args: tuple[str, ...], code: int) -> None:
    assert _into_closed_pipe(mapfold, *args) == (code, "")


def test_findings_are_exit_3_when_stdout_is_closed(mapfold: Commands) -> None:
    write_damaged_log(mapfold.folder / "damaged", walk(3))
    code, err = _into_closed_pipe(mapfold, "log", "verify", "damaged")
    assert code == 3
    assert "finding" in err


def test_an_import_completes_when_stderr_is_closed(mapfold: Commands) -> None:
    (mapfold.folder / "in.jsonl").write_text("not JSON\n")
    args = ("import", "new", "in.jsonl", "--json")
    code, out = _into_closed_pipe(mapfold, *args, stream="stderr")
    assert code == 3
    assert '"rejected": 1' in out


@pytest.mark.parametrize("unbuffered", [{}, {"PYTHONUNBUFFERED": "1"}], ids=["", "unbuffered"])
@pytest.mark.parametrize(
    "args",
    [
        ("state", "log", "--digest"),  # little: found out at the end
        ("log", "cat", "log", "--json"),  # much: found out on the way
        pytest.param(("log", "info", "log", "--json"), marks=pytest.mark.slow),
        pytest.param(("--help",), marks=pytest.mark.slow),
        pytest.param(("--version",), marks=pytest.mark.slow),
    ],
    ids=lambda args: args[0],
)
def test_stdout_on_a_full_disk_is_a_failure(
    mapfold: Commands, args: tuple[str, ...], unbuffered: dict[str, str]
) -> None:
    env = {k: v for k, v in mapfold.env.items() if k != "PYTHONUNBUFFERED"}
    with Path("/dev/full").open("wb") as full, tempfile.TemporaryFile() as stderr:
        run = Commands(mapfold.folder, env | unbuffered)
        process = run.start(*args, stdout=full.fileno(), stderr=stderr.fileno())
        assert process.wait(TIMEOUT_S) == 1
        stderr.seek(0)
        said = stderr.read()
    assert said == (b"mapfold: stdout: No space left on device; the output is not complete\n")


def test_stderr_on_a_full_disk_changes_nothing(mapfold: Commands) -> None:
    with Path("/dev/full").open("wb") as full, tempfile.TemporaryFile() as stdout:
        streams = {"stdout": stdout.fileno(), "stderr": full.fileno()}
        process = mapfold.start("log", "verify", "log", "--json", **streams)
        assert process.wait(TIMEOUT_S) == 0
        stdout.seek(0)
        assert b'"findings": []' in stdout.read()


def test_numbers_of_closed_streams_are_not_reused(mapfold: Commands) -> None:
    program = (
        "import os; from pathlib import Path\n"
        "from projections.surfaces.cli.program import run_app\n"
        "def app():\n"
        "    fds = [os.readlink(f'/proc/self/fd/{number}') for number in range(3)]\n"
        "    Path('fds').write_text(str([*fds, os.open('first', os.O_CREAT) > 2]))\n"
        "    print('said')\n"
        "run_app(app)"
    )
    done = subprocess.run(
        ["bash", "-c", '"$@" 0<&- 1>&- 2>&-', "bash", sys.executable, "-c", program],
        cwd=mapfold.folder,
        env={**mapfold.env, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert done.returncode == 0
    said = (mapfold.folder / "fds").read_text()
    assert said == "['/dev/null', '/dev/null', '/dev/null', True]"


def test_characters_outside_the_encoding_are_escaped(mapfold: Commands) -> None:
    encoded = Commands(mapfold.folder, {**mapfold.env, "PYTHONIOENCODING": "ascii"})
    assert r"saw \u2615 \U0001f916" in encoded("log", "cat", "log").out
    odd = os.fsdecode(b"l\xff")
    (mapfold.folder / "log").rename(mapfold.folder / odd)
    assert json.loads(mapfold("log", "info", odd, "--json").out)["path"] == odd


def test_the_version(mapfold: Commands) -> None:
    assert mapfold("--version").out == f"mapfold {version('mapfold')}\n"
