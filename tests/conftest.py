"""Fixtures every test may use; those of one subsystem live in ``tests/support/fixtures_*.py``."""

import gc
import os
import signal
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import is_hypothesis_test, settings
from hypothesis.internal.conjecture import providers

from eventsrc.base.text import shorten_by
from tests.support import prefork, thorough
from tests.support.commands import Commands
from tests.support.thorough import THOROUGH, examples

# How long an example takes says how busy the machine is; benchmarks measure speed.
settings.register_profile("mapfold", deadline=None, max_examples=examples(100))
settings.load_profile("mapfold")
if not THOROUGH:
    # Each worker would parse all modules that it has loaded, for two seconds, to try their numbers.
    providers._get_local_constants = lambda: providers._local_constants

# Tests that a shell or `nohup` starts in the background ignore these signals, and so does every
# program that they start; many tests send them to such programs.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

MANY_FILES = 300

pytest_plugins = [
    "tests.support.fixtures_postgres",
    "tests.support.fixtures_log",
    "tests.support.fixtures_serve",
    "tests.support.fixtures_zenoh",
]

UNIT = Path(__file__).parent / "unit"
INTEROP = Path(__file__).parent / "interop"
NETWORK = {"pg_server", "endpoint", "connected", "start", "start_code"}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not even import what is left out: with ``-m unit`` the tests elsewhere, with ``-m "not
    slow"`` those of tests/interop, which are all slow; None leaves it to pytest."""
    other = collection_path.parent == UNIT.parent and collection_path != UNIT
    only = config.option.markexpr
    ignored = (only == "unit" and other) or (only == "not slow" and collection_path == INTEROP)
    return True if ignored else None


def pytest_configure(config: pytest.Config) -> None:
    """Start the process that forks commands for all workers: each would take two seconds to."""
    workers = getattr(config.option, "numprocesses", None)
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    if workers and not (is_worker or config.option.markexpr == "unit"):
        os.environ[prefork.SHARED] = prefork.start_server()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Without the cyclic garbage collector, which would look through all modules and tests again
    and again while they are made; it also runs less often than usual while the tests run."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


def pytest_runtest_setup() -> None:
    """Leave ids whole: a command that an earlier test ran in this process has shortened them."""
    shorten_by(None)


def pytest_runtest_logfinish() -> None:
    """Close the files and sockets that only cycles of unused objects hold, before `select` and
    processes with a limit of 1,024 have too many of them."""
    if sum(1 for _ in Path("/dev/fd").iterdir()) > MANY_FILES:
        gc.collect()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of tests/unit that are quick and need neither a database nor a network, and
    the tests that try more, or may do so, when thorough."""
    for item in items:
        if _tries_more(item):
            item.add_marker(pytest.mark.thorough)
        slow = any(item.get_closest_marker(name) for name in ("slow", "seconds"))
        network = NETWORK & set(getattr(item, "fixturenames", ()))
        if UNIT in item.path.parents and not slow and not network:
            item.add_marker(pytest.mark.unit)


def _tries_more(item: pytest.Item) -> bool:
    """Whether the test or its module has more examples, sizes or cases under scripts/test_slow."""
    if item.get_closest_marker("slow") or is_hypothesis_test(getattr(item, "obj", None)):
        return True
    imported = vars(getattr(item, "module", thorough))
    amounts = ("THOROUGH", "examples", "every_other", "rounds", "stride")
    return any(name in imported for name in amounts)


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    """Commands in an empty folder."""
    return Commands.in_folder(tmp_path)
