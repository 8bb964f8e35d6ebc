"""How much memory a command takes at most, measured by itself."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

MOST_MIB = 600
"""What any command that reads may take, whatever it is given."""
_PROGRAM = """
import sys
from pathlib import Path
from projections.cli import main
try:
    main()
finally:
    # Not ru_maxrss, which begins with what the parent took.
    (line,) = [l for l in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in l]
    print(line, file=sys.stderr)
"""


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    said: str
    peak_mib: float


def run_measured(*arguments: str | Path, timeout_s: float = 240.0) -> Ran:
    """Run ``mapfold arguments`` in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    *said, last = done.stderr.splitlines()
    assert last.startswith("VmHWM:"), done.stderr
    return Ran(done.returncode, done.stdout + "\n".join(said), int(last.split()[1]) / 1024)
