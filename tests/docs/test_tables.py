"""Rows of a table have as many cells as its head: a bar in a cell, in code too, begins another."""

import re
from pathlib import Path

import pytest

from tests.docs.test_links import PAGES, ROOT

_BAR = re.compile(r"(?<!\\)\|")


def _tables(text: str) -> list[list[str]]:
    tables: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("|"):
            tables[-1].append(line)
        elif tables[-1]:
            tables.append([])
    return [table for table in tables if table]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_rows_have_as_many_cells_as_their_head(page: Path) -> None:
    for head, *rows in _tables(page.read_text("utf-8")):
        for row in rows:
            assert len(_BAR.findall(row)) == len(_BAR.findall(head)), row
