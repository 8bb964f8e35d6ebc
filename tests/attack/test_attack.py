"""A short attack on the real commands; `scripts/test_slow` has one of three minutes."""

import subprocess
import sys

from tests.docs.console import ROOT
from tests.thorough import rounds


def _attack(*arguments: str) -> None:
    """Run it in a process of its own; fails with its table."""
    command = [sys.executable, "-m", "tests.attack", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_short_attack_on_a_log() -> None:
    attacks = ("damage", "kills")[: rounds(2, 1)]
    _attack("--seed", "1", "--round", "1", "--only", *attacks)
