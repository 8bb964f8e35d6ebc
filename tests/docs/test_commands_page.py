"""Every command has help, and the page of commands says what the commands say."""

from typing import Any

import pytest

from tests.docs.commands_page import PAGE, commands, page

COMMANDS = dict(commands())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_parameter_has_help(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    assert [p.name for p in command.params if not getattr(p, "help", None)] == []


LISTED = ["state", "relocalize", "evaluate", "serve", "draw", "merges", "why", "diff", "bisect"]
LISTED += ["whatif", "query where", "query contents", "query holding", "query path"]


@pytest.mark.parametrize("path", LISTED)
def test_short_help_is_not_cut_off(path: str) -> None:
    """On a terminal of 80 columns the lists of --help have this much for each."""
    said = COMMANDS[f"mapfold {path}"].get_short_help_str(62)
    assert said.endswith(".")
    assert not said.endswith("...")


def test_the_page_is_what_the_commands_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run scripts/update_docs"


CONTRACT = ["demo", "simulate", "record", "import", "router", "replay", "tail", "status", "state"]
CONTRACT += ["relocalize", "log info", "log cat", "db url", "db start", "db stop"]


@pytest.mark.parametrize("path", CONTRACT)
def test_the_contracts_commands_are_there(path: str) -> None:
    assert f"mapfold {path}" in COMMANDS


def _options(command: Any) -> set[str]:
    return {flag for p in command.params for flag in p.opts}


@pytest.mark.parametrize(
    "path", ["demo", "status", "state", "relocalize", "log info", "log cat", "replay", "import"]
)
def test_commands_that_report_data_can_say_it_in_json(path: str) -> None:
    assert "--json" in _options(COMMANDS[f"mapfold {path}"])
