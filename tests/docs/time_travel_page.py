"""docs/time-travel.md, run on the shared house-a; `python -m tests.docs.time_travel_page` writes
its outputs anew."""

import os
import sys
from pathlib import Path

from tests.docs.console import ROOT, Command, File, matches, read, run

PAGE = ROOT / "docs" / "time-travel.md"
DATA = Path(os.environ.get("MAPFOLD_SHARED_DATA", ROOT.parent / "shared" / "data")) / "house"
FILES = ("house-a.jsonl.gz", "house-a.truth.jsonl.gz")

Ran = tuple[Command, int, list[str]]


def run_page() -> list[Ran]:
    """Each command of the page with its exit code and what it printed."""
    links: list[Command | File] = [Command(f"ln -s '{DATA / f}' .", [], 0, 0) for f in FILES]
    return run([*links, *read(PAGE)])[len(links) :]


def rewrite() -> None:
    lines = PAGE.read_text("utf-8").splitlines()
    for command, code, printed in reversed(run_page()):
        if code:
            sys.exit(f"{command.text}: exit {code}: {printed}")
        if not matches(command.prints, printed):
            lines[command.first + 1 : command.end] = printed
    PAGE.write_text("\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    rewrite()
