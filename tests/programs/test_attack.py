"""A short attack on the real commands; `scripts/test_slow` has one of three minutes."""

import resource

from scripts.programs.attack.__main__ import main
from tests.support.thorough import rounds


def test_a_short_attack_on_a_log() -> None:
    attacks = ("damage", "kills")[: rounds(2, 1)]
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        assert main(["--seed", "1", "--round", "1", "--only", *attacks]) == 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limit)
