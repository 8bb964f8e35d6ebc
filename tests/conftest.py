"""Fixtures every test may use; those of one subsystem live in ``tests/fixtures_*.py``."""

pytest_plugins = [
    "tests.fixtures_postgres",
    "tests.fixtures_log",
    "tests.fixtures_tls",
    "tests.fixtures_zenoh",
]
