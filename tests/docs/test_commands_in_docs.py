"""Every command in these documents runs and prints what they say."""

import re
from pathlib import Path

import pytest

from tests.docs.console import ROOT, Command, File, matches, read, run
from tests.support.thorough import THOROUGH, mostly_slow

DOCUMENTS = (
    "README.md",
    "docs/simulator.md",
    "docs/corrections.md",
    "docs/export.md",
    "docs/fusion.md",
    "docs/python.md",
    "docs/time-travel.md",
    "docs/tour.md",
)

LONG = ("scripts/demo", "mapfold calibrate logs/mine")
"""Run only when thorough: the demo's own test compares what the one prints, and the other is run
with ``--write`` too."""


@pytest.mark.parametrize("name", mostly_slow(DOCUMENTS))
def test_commands_print_what_the_document_says(name: str) -> None:
    parts = read(ROOT / name)
    if not THOROUGH:
        parts = [part for part in parts if isinstance(part, File) or part.text not in LONG]
    assert any(isinstance(part, Command) for part in parts)
    for command, code, printed in run(parts):
        told = "\n".join(printed)
        assert code == 0, f"{command.text}\nexit {code}\n{told}"
        assert matches(command.prints, printed), f"{command.text}\nprinted:\n{told}"


@pytest.mark.parametrize("name", DOCUMENTS)
def test_commands_of_documents_leave_no_untracked_files(name: str) -> None:
    for part in read(ROOT / name):
        if isinstance(part, Command):
            written = re.findall(r"(?:> (?!\d)|--out |--picture |mapfold import )(\S+)", part.text)
        else:
            written = [part.name]
        assert all(path.startswith("logs/") for path in written), part


def test_a_difference_is_seen_and_a_time_is_not() -> None:
    assert matches(["10 places in 0.62 s"], ["10 places in 1.70 s"])
    assert not matches(["10 places in 0.62 s"], ["11 places in 0.62 s"])
    assert not matches(["10 places"], ["10 places", "and a line more"])
    assert matches(["10 places", "…", "end"], ["10 places", "p0", "p1", "end"])
    assert not matches(["10 places", "…", "end"], ["10 places", "p0"])
    assert matches(["digest 1234…"], ["digest 12345678"])


def test_files_in_a_document_are_read_whole(tmp_path: Path) -> None:
    document = tmp_path / "doc.md"
    document.write_text(
        '```python title="two.py"\nprint(2)\n```\n```console\n$ python two.py\n2\n```\n'
    )
    file, command = read(document)
    assert (file.name, file.text) == ("two.py", "print(2)\n")  # type: ignore[union-attr]
    assert isinstance(command, Command)
    assert (command.text, command.prints) == ("python two.py", ["2"])
