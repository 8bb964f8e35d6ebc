"""Fixtures every test may use; those of one subsystem live in ``tests/fixtures_*.py``."""

pytest_plugins = [
    "tests.fixtures_zenoh",
]
