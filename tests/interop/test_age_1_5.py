"""Replay, tail, checks, refolds, roles and every kind of question on Debian 13's packages, whose
AGE 1.5 is the oldest that mapfold supports."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.servers import NoDebianPackages, debian_server

TESTS = Path(__file__).resolve().parents[1] / "integration"
MODULES = (
    "test_asked_maps.py",
    "test_candidates_follow_the_map.py",
    "test_database_commands.py",
    "test_db_check.py",
    "test_floors_in_databases.py",
    "test_maps_in_databases.py",
    "test_projections.py",
    "test_refold.py",
    "test_relocalize_databases.py",
    "test_replay_workers.py",
    "test_roles.py",
    "test_serve.py",
    "test_serve_http.py",
    "test_tail_live.py",
    "test_walls_in_answers.py",
)
WAIT_S = 280

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    try:
        with debian_server() as found:
            yield found
    except NoDebianPackages as reason:
        pytest.skip(f"no PostgreSQL 17 with AGE 1.5 to be had here: {reason}")


@pytest.mark.parametrize("name", MODULES)
def test_all_that_uses_a_database_passes_on_the_oldest_age(url: str, name: str) -> None:
    # A run of its own: this one's server is another.
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("MAPFOLD_TEST_", "PYTEST_"))}
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", "-q", "-p", "no:schemathesis", "-m", "not slow",
            str(TESTS / name),
        ],
        env={**kept, "MAPFOLD_TEST_DB": url},
        cwd=TESTS.parents[1],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-10_000:]
