"""Every relative link of README and docs, and each module they name, is in the repository."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "logs" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_MODULE = re.compile(r"`((?:eventsrc|projections|tests|scripts)/[\w/]+\.py)`")
_BARE = re.compile(r"`(\w+\.py)`")
_LINK = re.compile(r"\]\((?!https?://|#|mailto:)([^)#\s]+)(?:#[^)]*)?\)")


@pytest.fixture(scope="module")
def file_names() -> frozenset[str]:
    folders = ("eventsrc", "projections", "tests", "scripts")
    return frozenset(path.name for each in folders for path in (ROOT / each).rglob("*.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in _LINK.findall(page.read_text("utf-8")):
        assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_named_modules_are_there(page: Path) -> None:
    for path in _MODULE.findall(page.read_text("utf-8")):
        assert (ROOT / path).is_file(), path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_modules_named_without_a_folder_are_there(page: Path, file_names: frozenset[str]) -> None:
    assert set(_BARE.findall(page.read_text("utf-8"))) <= file_names


def test_links_are_found() -> None:
    text = (
        "a [page](docs/x.md), [part](y.md#there), [site](https://z), ![picture](p.png) [here](#h)"
    )
    assert _LINK.findall(text) == ["docs/x.md", "y.md", "p.png"]
