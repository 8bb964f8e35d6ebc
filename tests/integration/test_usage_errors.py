"""A call that is wrong: which option, what value, what would be right; exit 2."""

import json
from pathlib import Path

import pytest

from tests.support.commands import Commands
from tests.support.hostile_options import hostile_lines, prepared
from tests.support.logs import walk
from tests.support.thorough import rounds
from tests.support.walks import write_log


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    write_log(tmp_path / "log", walk(3))
    (tmp_path / "settings.json").write_text(json.dumps({"eps": 1}))
    (tmp_path / "broken.json").write_text("{")
    return Commands.in_folder(tmp_path)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("simulate", "--key", "a b/*"), "--key 'a b/*': it has one of the characters * $ ? #"),
        (("whatif", "log", "--try", "eps=1"), "--try eps=1: no setting 'eps'; there are"),
        (("whatif", "log", "--grid", "eps_m=1,x"), "--grid eps_m=x: input should be a valid"),
        (("whatif", "log", "--base", "eps=1"), "--base eps=1: no setting 'eps'; there are"),
        (
            ("state", "log", "--settings", "settings.json"),
            "--settings settings.json: no setting 'eps'; there are embedding_dim",
        ),
        (("state", "log", "--settings", "broken.json"), "--settings broken.json: not JSON: "),
        (
            ("state", "log", "--settings", "none.json"),
            "--settings none.json: No such file or directory",
        ),
    ],
)
def test_our_own_errors_are_one_line(mapfold: Commands, args: tuple[str, ...], says: str) -> None:
    (line,) = mapfold(*args, code=2).err.splitlines()
    assert line.startswith(f"mapfold: {says}")


@pytest.mark.parametrize(
    ("args", "name"),
    [
        (("export", "log", "--foxglove="), "--foxglove"),
        (("export", "log", "--rerun", ""), "--rerun"),
        (("simulate", "--out="), "--out"),
        (("reembed", "log", "--encoder="), "--encoder"),
        (("db", "check", ""), "LOG"),
        (("state", "log", "--settings="), "--settings"),
        (("import", "other", ""), "FILE"),
    ],
)
def test_an_empty_path_is_refused(mapfold: Commands, args: tuple[str, ...], name: str) -> None:
    before = {*mapfold.folder.iterdir()}
    said = mapfold(*args, code=2).err
    assert name in said
    assert "empty" in said
    assert {*mapfold.folder.iterdir()} == before


def test_a_recording_for_foxglove_goes_into_no_pipe(mapfold: Commands) -> None:
    with prepared(mapfold.folder):
        (line,) = mapfold("export", "log", "--foxglove=fifo", code=2).err.splitlines()
    assert line == "mapfold: fifo: an MCAP recording goes to a file, not a pipe; choose one"


@pytest.mark.seconds
def test_hostile_values_of_any_option_end_without_a_traceback(mapfold: Commands) -> None:
    """A sample of what `scripts.programs.attack` tries."""
    lines = [*hostile_lines()]
    with prepared(mapfold.folder):
        for line in lines[:: rounds(61, 997)]:
            said = mapfold(*line, code=None)
            assert said.code in (0, 1, 2, 3), line
            assert "Traceback" not in said.err, line


def test_a_value_that_is_not_offered(mapfold: Commands) -> None:
    said = mapfold("replay", "log", "--only", "foo", code=2).err
    assert "Invalid value for '--only': 'foo' is not one of 'graph', 'vectors'" in said
