"""docs/licences.md names every library that mapfold or an extra of it depends on."""

import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_library_has_its_licence() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {_plain(re.split(r"[\[<>=; ]", each)[0]) for each in wanted}
    page = (ROOT / "docs" / "licences.md").read_text()
    rows = re.findall(r"^\| (\S+) +\| (\S.*?) +\|", page, re.MULTILINE)
    licences = {_plain(name): licence for name, licence in rows}
    assert names <= set(licences), "scripts/release writes the page"
    text, _, _ = page.partition("| Name")
    assert all(f"`{name}`" in text for name in names if licences[name] == "UNKNOWN")


def test_the_citation_and_the_package_have_one_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited == [project["version"]]
