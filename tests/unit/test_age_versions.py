"""Which versions of Apache AGE keep readers from writing."""

import pytest

from projections.postgres.cypher import enforces_row_security


@pytest.mark.parametrize(
    ("version", "enforces"),
    [
        ("1.5.0", False),
        ("1.6.0", False),
        ("1.7.0", True),
        ("1.7.0-rc1", True),
        ("1.8.0", True),
        ("1.10.0", True),
        ("2.0.0", True),
        ("0.7.0", False),
        ("", False),
        ("unknown", False),
    ],
)
def test_enforces_row_security(version: str, enforces: bool) -> None:
    assert enforces_row_security(version) is enforces
