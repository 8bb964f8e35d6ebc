"""Every command has help, and the page of commands says what the commands say."""

import inspect
import re
import shutil
import subprocess
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from eventsrc.record.transport.config import DEFAULT_ENDPOINT
from projections.surfaces.cli import command_line
from tests.docs.commands_page import MAN_PAGE, PAGE, commands, man_page, page


@pytest.fixture(scope="module")
def by_name() -> dict[str, Any]:
    return dict(commands())


def test_every_command_and_parameter_has_help(by_name: dict[str, Any]) -> None:
    assert len(by_name) > 40
    assert [name for name, command in by_name.items() if not command.help] == []
    assert [
        (name, p.name)
        for name, command in by_name.items()
        for p in command.params
        if not getattr(p, "help", None)
    ] == []


def test_values_have_a_name_of_their_own(by_name: dict[str, Any]) -> None:
    """Else ``--help`` shows their type, as ``--seed <int range>``."""
    named_by_type = [
        (name, p.name)
        for name, command in by_name.items()
        for p in command.params
        if p.metavar is None and not getattr(p, "is_flag", False)
    ]
    assert named_by_type == []


def test_the_pages_have_the_defaults() -> None:
    assert "| `--seed N` | Which simulated house. [default: 7] |" in PAGE.read_text("utf-8")
    assert "Which simulated house. [default: 7]" in MAN_PAGE.read_text("utf-8")
    assert "| `--zenoh, --no-zenoh` | Answer over Zenoh. [default: zenoh] |" in page()


def test_the_default_of_connect_is_that_of_the_command(by_name: dict[str, Any]) -> None:
    """A router connects to nothing by default, and neither does a program that listens."""
    for name, command in by_name.items():
        helps = {option.name: option.help for option in command.params}
        if "connect" not in helps:
            continue
        if name == "mapfold router":
            assert "default" not in helps["connect"]
        else:
            assert DEFAULT_ENDPOINT in helps["connect"]
            assert ("none with --listen" in helps["connect"]) == ("listen" in helps), name


def test_tables_in_help_are_code_in_the_page() -> None:
    """Without the indent their lines run together in the page."""
    said = page()
    assert '\n    bash   eval "$(mapfold completion bash)" ' in said
    assert "\n    place_count() " in said


@pytest.mark.parametrize("path", ["", "log", "db", "fleet", "edit"])
def test_lists_of_commands_show_whole_sentences(path: str) -> None:
    program = command_line()
    group: Any = typer.main.get_command(program)
    said = CliRunner().invoke(program, [*path.split(), "--help"], terminal_width=80).output
    for name in path.split():
        group = group.commands[name]
    assert len(group.commands) > 2
    for name, command in group.commands.items():
        first = inspect.cleandoc(command.help).split("\n\n")[0]
        assert f"{name} {' '.join(first.split())}" in " ".join(said.split())


def test_the_page_is_what_the_commands_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run scripts/update_docs"
    assert MAN_PAGE.read_text(encoding="utf-8") == man_page(), "run scripts/update_docs"


def test_the_man_page_names_every_command_and_option(by_name: dict[str, Any]) -> None:
    said = man_page()
    for name, command in by_name.items():
        assert name.replace("-", r"\-") in said
        for option in (flag for each in command.params for flag in each.opts if flag[0] == "-"):
            assert option.replace("-", r"\-") in said


@pytest.mark.skipif(not shutil.which("groff"), reason="groff is not installed")
def test_the_man_page_is_right_roff() -> None:
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", "-k", MAN_PAGE], capture_output=True, check=True
    )
    assert done.stderr == b""
    bold = re.compile("(.)\b\\1")
    assert "mapfold relocalize" in bold.sub(r"\1", done.stdout.decode())


CONTRACT = ["demo", "simulate", "record", "import", "router", "replay", "tail", "status", "state"]
CONTRACT += ["relocalize", "log info", "log cat", "db url", "db start", "db stop"]


@pytest.mark.parametrize("path", CONTRACT)
def test_the_contracts_commands_are_there(path: str, by_name: dict[str, Any]) -> None:
    assert f"mapfold {path}" in by_name


def _options(command: Any) -> set[str]:
    return {flag for p in command.params for flag in p.opts}


@pytest.mark.parametrize(
    "path", ["demo", "status", "state", "relocalize", "log info", "log cat", "replay", "import"]
)
def test_commands_that_report_data_can_say_it_in_json(path: str, by_name: dict[str, Any]) -> None:
    assert "--json" in _options(by_name[f"mapfold {path}"])
