"""The wheel, as pip builds it."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_wheel_has_one_man_page_and_the_page_of_the_debugger(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", tmp_path, ROOT]
    subprocess.run(build, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    (page,) = (name for name in names if name.endswith("mapfold.1"))
    assert page.endswith(".data/data/share/man/man1/mapfold.1")
    assert "mapfold.py" in names
    assert any(name.startswith("projections/surfaces/ui/static/") for name in names)
    assert not any(name.startswith("projections/surfaces/ui/web/") for name in names)


def test_a_file_with_a_place_of_its_own_is_not_in_the_packages_too() -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"][
        "targets"
    ]["wheel"]
    assert wheel["shared-data"].keys() <= set(wheel["exclude"])
    assert all((ROOT / name).exists() for name in wheel["exclude"])
