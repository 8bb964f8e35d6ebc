"""Fixtures every test may use; those of one subsystem live in ``tests/fixtures_*.py``."""

from hypothesis import settings

# How long an example takes says how busy the machine is; benchmarks measure speed.
settings.register_profile("mapfold", deadline=None)
settings.load_profile("mapfold")

pytest_plugins = [
    "tests.fixtures_postgres",
    "tests.fixtures_log",
    "tests.fixtures_tls",
    "tests.fixtures_zenoh",
]
