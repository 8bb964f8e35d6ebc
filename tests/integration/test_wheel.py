"""The wheel and the source distribution, as a package index gets them."""

import email.parser
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"\]\(([^)]*)\)")


def build(tools: Path, out: Path) -> tuple[Path, Path]:
    """The wheel and the source distribution, built by what is in ``tools``."""
    hatchling = [sys.executable, "-m", "hatchling", "build", "-d", out]
    subprocess.run(hatchling, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(tools)}, check=True)
    (wheel,), (source,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, source


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path]]:
    """Two builds by the same tools."""
    tools = tmp_path_factory.mktemp("tools")
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", tools, *needed]
    subprocess.run(install, check=True)
    return [build(tools, tmp_path_factory.mktemp("dist")) for _ in range(2)]


@pytest.mark.slow
def test_the_wheel_has_one_man_page_and_the_page_of_the_debugger(
    built: list[tuple[Path, Path]],
) -> None:
    with zipfile.ZipFile(built[0][0]) as archive:
        names = archive.namelist()
    (page,) = (name for name in names if name.endswith("mapfold.1"))
    assert page.endswith(".data/data/share/man/man1/mapfold.1")
    assert "mapfold.py" in names
    assert any(name.startswith("projections/surfaces/ui/static/") for name in names)
    assert not any(name.startswith("projections/surfaces/ui/web/") for name in names)


@pytest.mark.slow
def test_the_description_leads_to_no_file_that_an_index_does_not_have(
    built: list[tuple[Path, Path]],
) -> None:
    with zipfile.ZipFile(built[0][0]) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        metadata = email.parser.Parser().parsestr(archive.read(name).decode())
    assert metadata["Description-Content-Type"] == "text/markdown"
    description = str(metadata.get_payload())
    assert description.startswith("# mapfold\n")
    assert "docs/tour.md" in description
    assert "![" not in description
    assert LINK.findall(description) == []


@pytest.mark.slow
def test_the_source_distribution_has_what_the_readme_links_to_and_runs(
    built: list[tuple[Path, Path]],
) -> None:
    with tarfile.open(built[0][1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    links = set(LINK.findall((ROOT / "README.md").read_text()))
    assert links
    needed = links | {"scripts/demo", "scripts/test", "logs/sample/00000000000000000000.mcap"}
    assert needed <= names
    assert not any(".venv/" in name or "__pycache__" in name for name in names)


@pytest.mark.slow
def test_two_builds_are_byte_identical(built: list[tuple[Path, Path]]) -> None:
    first, second = ([path.read_bytes() for path in each] for each in built)
    assert first == second


def test_a_file_with_a_place_of_its_own_is_not_in_the_packages_too() -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"][
        "targets"
    ]["wheel"]
    assert wheel["shared-data"].keys() <= set(wheel["exclude"])
    assert all((ROOT / name).exists() for name in wheel["exclude"])
