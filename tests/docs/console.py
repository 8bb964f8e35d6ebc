"""Documents whose commands are run: reading them, running them, comparing, rewriting.

In a fenced block ``console`` a line that starts with ``$ `` is a command, and what follows it, up
to the next one, is what it prints, stdout and stderr together. A block ``python title="NAME.py"``
is a file that commands after it may use. All commands of a document run in one bash, in one fresh
folder, which documents know as ``HOME_OF_DOCS``.

What differs from time to time is put out of sight on both sides before comparing (`_VARYING`). A
line that is only ``…`` stands for any lines, a ``…`` within a line for any text.

    python -m tests.docs.console README.md          rewrites the outputs in the document
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import quote

from tests.support.prefork import folder_with_mapfold
from tests.support.servers import furnish

ROOT: Final = Path(__file__).resolve().parents[2]
HOME_OF_DOCS: Final = "/home/you/mapfold"
_DEMO: Final = """#!/usr/bin/env bash
PATH=/usr/bin:/bin exec .venv/bin/python -m projections.surfaces.cli demo "$@"
"""
_MARK: Final = "@@ command ended with"
_TIMEOUT_S: Final = 240
_VARYING: Final = (
    (re.compile(r"\b\d+(\.\d+)? (s|ms)\b(?! (of driving|through))"), "<time>"),
    (re.compile(r"\b[\d,]+ events/s"), "<rate>"),
    (re.compile(r"\b\d+ transactions\b"), "<count> transactions"),
    (re.compile(r"\b[0-9a-f]{32}\b"), "<log id>"),
    (re.compile(r"(?<=logged    ).*"), "<time> to <time>"),
)


@dataclass(frozen=True)
class Command:
    """A command of a document and what the document says it prints; lines of the file, from 0."""

    text: str
    prints: list[str]
    first: int
    end: int


@dataclass(frozen=True)
class File:
    """A file that a document shows in full."""

    name: str
    text: str


def read(document: Path) -> list[Command | File]:
    """Everything in ``document`` that can be run, in order."""
    found: list[Command | File] = []
    lines = document.read_text("utf-8").splitlines()
    for kind, first, end in _blocks(lines):
        words = kind.split()
        if words[:1] == ["console"]:
            found += _commands(lines, first, end)
        elif titled := re.fullmatch(r'python title="(.+)"', kind):
            found.append(File(titled[1], "\n".join(lines[first:end]) + "\n"))
    return found


def run(parts: list[Command | File]) -> list[tuple[Command, int, list[str]]]:
    """Run the commands in a fresh folder with the sample log; exit code and lines of each."""
    with tempfile.TemporaryDirectory(prefix="mapfold-docs-", dir="/tmp") as folder:
        _furnish(Path(folder))
        script = "exec 2>&1\n"
        commands = [part for part in parts if isinstance(part, Command)]
        for part in parts:
            if isinstance(part, File):
                Path(folder, part.name).write_text(part.text, "utf-8")
            else:
                script += f'{part.text}\necho "{_MARK} $?"\n'
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=folder,
            env=_environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=_TIMEOUT_S,
        )
    text = done.stdout.replace(folder, HOME_OF_DOCS)
    text = text.replace(quote(folder, safe=""), quote(HOME_OF_DOCS, safe=""))
    return [(command, *output) for command, output in zip(commands, _outputs(text), strict=True)]


def matches(says: list[str], printed: list[str]) -> bool:
    """Whether what was printed is what the document says."""
    pattern = ""
    for line in says:
        if line.strip() == "…":
            pattern += r"(?:.*\n)*?"
        else:
            pattern += ".*".join(re.escape(part) for part in _steady(line).split("…")) + r"\n"
    text = "".join(_steady(line) + "\n" for line in printed)
    return re.fullmatch(pattern, text) is not None


def _furnish(folder: Path) -> None:
    """The sample log, and a scripts/demo that finds its virtual environment made already."""
    (folder / "logs").mkdir()
    shutil.copytree(ROOT / "logs" / "sample", folder / "logs" / "sample")
    (folder / "scripts").mkdir()
    demo = folder / "scripts" / "demo"
    demo.write_text(_DEMO, "utf-8")
    demo.chmod(0o755)
    (folder / ".venv").symlink_to(sys.prefix)
    furnish(folder / ".mapfold")


def _environment() -> dict[str, str]:
    """As a user's shell has it: mapfold on the path, nothing set that changes what it does."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("MAPFOLD")}
    path = os.pathsep.join(
        [str(folder_with_mapfold()), str(Path(sys.executable).parent), kept["PATH"]]
    )
    return {**kept, "PATH": path, "COLUMNS": "100"}


def _outputs(text: str) -> Iterator[tuple[int, list[str]]]:
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith(_MARK):
            yield int(line.rpartition(" ")[2]), lines
            lines = []
        else:
            lines.append(line.rstrip())


def _blocks(lines: list[str]) -> Iterator[tuple[str, int, int]]:
    """Kind, first line and end of each fenced block."""
    opened: int | None = None
    for index, line in enumerate(lines):
        if line.startswith("```"):
            if opened is None:
                opened = index
            else:
                yield lines[opened][3:].strip(), opened + 1, index
                opened = None


def _commands(lines: list[str], first: int, end: int) -> Iterator[Command]:
    starts = [index for index in range(first, end) if lines[index].startswith("$ ")]
    for start, stop in zip(starts, [*starts[1:], end], strict=True):
        yield Command(lines[start][2:], lines[start + 1 : stop], start, stop)


def _steady(line: str) -> str:
    for pattern, instead in _VARYING:
        line = pattern.sub(instead, line)
    return line.rstrip()


def _rewrite(document: Path) -> None:
    lines = document.read_text("utf-8").splitlines()
    for command, code, printed in reversed(run(read(document))):
        if code:
            sys.exit(f"{command.text}: exit {code}: {printed}")
        if not matches(command.prints, printed):
            lines[command.first + 1 : command.end] = printed
    document.write_text("\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        _rewrite(Path(name))
