"""The architecture page names files and layers that exist, and every package."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")


def test_every_file_it_names_exists() -> None:
    files = re.findall(r"`((?:eventsrc|projections)/[\w/]+\.py)`", PAGE)
    assert len(files) > 20
    assert [file for file in files if not (ROOT / file).is_file()] == []


def test_it_names_every_package_and_layer() -> None:
    for package in ("eventsrc", "projections"):
        for folder in (ROOT / package).iterdir():
            if (folder / "__init__.py").is_file():
                assert f"`{folder.name}/`" in PAGE, folder.name
        for name in _layers(package):
            assert f"`{name}`" in PAGE or f"`{name}/`" in PAGE, name


def test_every_package_has_a_contract_whose_modules_exist() -> None:
    for package in ("eventsrc", "projections"):
        for folder in (ROOT / package).iterdir():
            if (folder / "__init__.py").is_file():
                layers = _layers(f"{package}.{folder.name}")
                assert len(layers) > 1, folder.name
                found = {path.stem for path in folder.iterdir()}
                assert [name for name in layers if name not in found] == []


def _layers(package: str) -> list[str]:
    """The names in a package's contract of layers; none if it has no contract."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    return [
        name
        for contract in contracts["contracts"]
        if contract["type"] == "layers" and contract["containers"] == [package]
        for layer in contract["layers"]
        for name in re.split(r"\s*[|:]\s*", layer)
    ]
