"""How much memory a command takes at most, measured by itself."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from projections.surfaces.cli import main
from tests.support import prefork

MOST_MIB = 600
"""What any command that reads may take, whatever it is given."""


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    said: str
    peak_mib: float


def run_measured(*arguments: str | Path, timeout_s: float = 240.0) -> Ran:
    """Run ``mapfold arguments`` in a process of its own."""
    done = prefork.run(
        "tests.support.memory:main_measured",
        ["mapfold", *map(str, arguments)],
        env=os.environ,
        cwd=Path.cwd(),
        timeout=timeout_s,
    )
    *said, last = done.stderr.decode().splitlines()
    assert last.startswith("VmHWM:"), done.stderr
    return Ran(done.returncode, done.stdout.decode() + "\n".join(said), int(last.split()[1]) / 1024)


def main_measured() -> None:
    """Run the command line in this process and print the most memory it took to stderr."""
    try:
        main()
    finally:
        # Not ru_maxrss, which begins with what the parent took.
        (line,) = [x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x]
        print(line, file=sys.stderr)
