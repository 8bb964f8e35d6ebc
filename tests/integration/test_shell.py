"""What a shell asks of the program: help, version, completions, a man page."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from projections.surfaces.cli import SECTIONS, command_line
from projections.surfaces.cli.composition import Program
from projections.surfaces.cli.program import _needed
from tests.support.commands import Commands
from tests.support.prefork import folder_with_mapfold
from tests.support.thorough import rounds


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def test_help_is_found_in_each_usual_way(mapfold: Commands) -> None:
    for path in ([], ["db", "check"])[-rounds(2, 1) :]:
        said = mapfold(*path, "--help").out
        assert mapfold(*path, "-h").out == said == mapfold("help", *path).out
    refused = mapfold("help", "nope", code=2).err
    assert "No such command 'nope'" in refused


def test_help_lists_every_command_in_its_section() -> None:
    program = get_command(command_line())
    said = program.make_context("mapfold", [], resilient_parsing=True).get_help()
    listed: dict[str, list[str]] = {}
    for line in said.split("Options:")[1].splitlines():
        if line.endswith(":"):
            listed[line.removesuffix(":")] = names = []
        elif found := re.match(r"  (\w+) ", line):
            names.append(found[1])
    assert listed == {title: list(commands) for title, commands in SECTIONS.items()}
    assert isinstance(program, Program)
    assert set(program.commands) == {name for names in listed.values() for name in names}


def test_the_version_is_printed(mapfold: Commands) -> None:
    said = mapfold("-V").out
    assert said == mapfold("--version").out
    assert said.startswith("mapfold 0.")


OFFERED = {
    "mapfold stat": {"state", "status"},
    "mapfold db ch": {"check"},
    "mapfold state log --set": {"--set", "--settings"},
    "mapfold draw log --preset ": {"classic", "full", "rooms"},
    "mapfold state l": set(),  # so that bash offers files
}


@pytest.mark.seconds
def test_bash_completes(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    script = f"""
PATH={folder_with_mapfold()}:$PATH
eval "$(mapfold completion bash)"
for typed in "$@"; do
    IFS=' ' read -ra COMP_WORDS <<< "$typed"
    case "$typed" in *" ") COMP_WORDS+=("");; esac
    COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
    _mapfold_completion mapfold
    IFS=' '
    echo "${{COMPREPLY[*]}}"
done
"""
    done = subprocess.run(
        ["bash", "-c", script, "bash", *OFFERED],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=True,
    )
    assert done.stderr == ""
    offered = [set(line.split()) for line in done.stdout.splitlines()]
    assert dict(zip(OFFERED, offered, strict=True)) == OFFERED


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_there_is_a_script_for_each_shell(shell: str, mapfold: Commands) -> None:
    script = mapfold("completion", shell).out
    assert "_MAPFOLD_COMPLETE" in script
    assert f"complete_{shell}" in script


def test_another_shell_is_refused_with_the_ones_there_are(mapfold: Commands) -> None:
    refused = mapfold("completion", "tcsh", code=2).err
    assert "'tcsh' is not one of 'bash', 'zsh', 'fish'" in refused


def test_the_man_page_is_installed() -> None:
    assert (Path(sys.prefix) / "share" / "man" / "man1" / "mapfold.1").is_file()


@pytest.mark.parametrize(
    ("typed", "modules"),
    [
        ("mapfold log ", 1),  # completes the words of a command: only its module is needed
        ("mapfold lo", 2),
        ("mapfold ", 2),
    ],
)
@pytest.mark.parametrize("variable", ["COMP_WORDS", "_TYPER_COMPLETE_ARGS"])
def test_completing_imports_only_the_command_that_is_typed(
    typed: str, modules: int, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = {"log": "its module", "state": "another"}
    monkeypatch.setattr(sys, "argv", ["mapfold"])
    monkeypatch.setenv("_MAPFOLD_COMPLETE", "complete_bash")
    monkeypatch.setenv(variable, typed)
    assert len(_needed(commands)) == modules


def test_the_version_needs_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["mapfold", "--version"])
    assert _needed({"log": "its module"}) == {}
