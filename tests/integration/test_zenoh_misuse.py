"""Zenoh options that are wrong in themselves: one line, exit 2, and nothing begun."""

from pathlib import Path

import pytest

from tests.support.commands import Commands
from tests.support.thorough import mostly_slow

_SPEAKING = (("record", "log"), ("router",), ("simulate",))


@pytest.mark.parametrize("command", _SPEAKING, ids=lambda command: command[0])
@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    mostly_slow(
        [
            ("--connect", "foo", "endpoint 'foo' has no protocol"),
            ("--listen", "tcp/here", "endpoint 'tcp/here' has no port"),
            ("--zenoh-config", "no-file", "no-file: no such Zenoh configuration file"),
        ]
    ),
)
def test_a_bad_zenoh_option_is_misuse(
    tmp_path: Path, command: tuple[str, ...], option: str, value: str, complaint: str
) -> None:
    said = Commands.in_folder(tmp_path)(*command, option, value, code=2)
    (line,) = said.err.splitlines()
    assert line.startswith(f"mapfold: {complaint}")
    assert list(tmp_path.iterdir()) == []
