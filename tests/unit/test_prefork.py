"""Programs that tests have forked behave as newly started programs: `subprocess` is the oracle."""

import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.support import prefork
from tests.support.commands import Commands

pytestmark = pytest.mark.seconds  # which the process that forks takes to start

WAIT_S = 60.0
ENDS = {
    "at its end": "import os; os.getpid()",
    "with a code": "import sys; sys.exit(7)",
    "with a text": "import sys; sys.exit('why')",
    "by an exception": "import sys; sys.tracebacklimit = 0; raise ValueError('this')",
    "by Ctrl-C": "import sys; sys.tracebacklimit = 0; raise KeyboardInterrupt",
    "killed": "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
    "with what is still to be done": "import atexit; atexit.register(print, 'later'); print('now')",
    "with a thread at work": (
        "import threading; go = threading.Event();"
        " threading.Thread(target=lambda: go.wait(0.1) or print('last')).start()"
    ),
    "on a full disk": "import sys; sys.stdout = open('/dev/full', 'w'); print('lost')",
    "asking what it is": "import os, sys; print(sys.argv, os.getcwd(), os.environ['ASKED'])",
    "after it has read": "import sys; print(sys.stdin.read().upper())",
}


@pytest.mark.parametrize("code", ENDS.values(), ids=ENDS)
def test_it_ends_and_says_what_a_new_process_does(code: str, tmp_path: Path) -> None:
    env, argv, stdin = {**os.environ, "ASKED": "ä\udcff"}, ["-c", "a b", "☕"], b"given"
    new = subprocess.run(
        [sys.executable, "-c", code, *argv[1:]],
        env=env, cwd=tmp_path, input=stdin, capture_output=True, check=False,
    )  # fmt: skip
    forked = prefork.run(code, argv, env=env, cwd=tmp_path, stdin=stdin, timeout=WAIT_S)
    assert (forked.returncode, forked.stdout) == (new.returncode, new.stdout)
    assert forked.stderr.splitlines()[-1:] == new.stderr.splitlines()[-1:]


def test_arguments_may_be_long(tmp_path: Path) -> None:
    code, long = "import sys; print(len(sys.argv[1]))", "x" * 100_000
    done = prefork.run(code, ["-c", *[long] * 10], env=os.environ, cwd=tmp_path, timeout=WAIT_S)
    assert done.stdout == b"100000\n"


def test_one_that_runs_is_polled_waited_for_and_killed(tmp_path: Path) -> None:
    code = "import signal; signal.pause()"
    process = prefork.start(code, ["-c"], env=os.environ, cwd=tmp_path)
    assert process.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.01)
    process.send_signal(signal.SIGTERM)
    assert process.wait(WAIT_S) == process.poll() == -signal.SIGTERM
    process.kill()  # as of `subprocess`, no error
    with pytest.raises(subprocess.TimeoutExpired):
        prefork.run(code, ["-c"], env=os.environ, cwd=tmp_path, timeout=0.01)


def test_the_mapfold_of_scripts(tmp_path: Path) -> None:
    path = f"{prefork.folder_with_mapfold()}{os.pathsep}{os.environ['PATH']}"
    (tmp_path / "in.jsonl").write_text("no JSON\n")
    script = "mapfold --version; cat in.jsonl | mapfold import log -; echo $?; mapfold log | wc -l"
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env={**os.environ, "PATH": path},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    said = Commands.in_folder(tmp_path)("log", code=2)
    first, *_, code, lines = done.stdout.splitlines()
    assert (first, code) == (f"mapfold {version('mapfold')}", "3")
    assert int(lines) == len(said.out.splitlines())
    assert said.err in done.stderr
