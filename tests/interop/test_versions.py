"""mapfold with the oldest versions of its dependencies that pyproject.toml allows, and on each
Python that is installed."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.logs import sample_drive

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = sample_drive()
ROOMS = ("--set", "eps_m=0.75", "--set", "min_samples=8")
DIGEST = "83caf24df6303ddf85522676f0ae726b671725573c6044e0743eb7af2691aab1"
EXTRAS = "serve,ui,foxglove,detector,ros,cluster,align,mcp"
UV = Path(sys.executable).with_name("uv")

pytestmark = pytest.mark.slow


def installed(folder: Path, python: str, *options: str) -> Path:
    """The folder of programs of a new environment with mapfold in it."""
    venv = folder / "venv"
    for arguments in (
        ["venv", "--python", python, venv],
        ["pip", "install", "--python", venv / "bin" / "python", *options, f"{ROOT}[{EXTRAS}]"],
    ):
        done = subprocess.run(
            [UV, *arguments, "--quiet"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    return venv / "bin"


def check(programs: Path, folder: Path) -> None:
    """Help of every command, a fold, a rebuild, a question, exports."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("MAPFOLD_", "PYTHON"))}
    env = {**clean, "MAPFOLD_HOME": str(folder / "home"), "COLUMNS": "100"}

    def mapfold(*arguments: object) -> str:
        done = subprocess.run(
            [programs / "mapfold", *map(str, arguments)],
            capture_output=True, text=True, check=False, cwd=folder, env=env,
        )  # fmt: skip
        assert done.returncode == 0, f"{arguments}: {done.stderr}"
        return done.stdout

    for code in (HELP_OF_ALL, DESCRIBED):
        done = subprocess.run(
            [programs / "python", "-c", code], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    assert mapfold("state", SAMPLE, *ROOMS, "--digest").strip() == DIGEST
    mapfold("replay", SAMPLE, *ROOMS)
    mapfold("simulate", "--run", "b", "--out", "b.jsonl")
    (folder / "question.json").write_text((folder / "b.jsonl").read_text().splitlines()[36])
    assert mapfold("relocalize", "question.json").startswith("p0 (confidence")
    mapfold("import", "mine", "b.jsonl")
    mapfold("tail", SAMPLE, "--once", *ROOMS)
    mapfold("db", "check", SAMPLE, *ROOMS)
    mapfold("draw", SAMPLE, "--out", "map.png")
    for kind in ("graphml", "dot", "geojson", "nav2", "foxglove"):
        mapfold("export", SAMPLE, f"--{kind}", f"map.{kind}")
    assert mapfold("completion", "bash")


def test_a_release_is_the_same_bytes_whoever_builds_it(folder: Path) -> None:
    """From two folders, at two times."""
    found = []
    for name in ("one", "other"):
        tree = folder / name / "mapfold"
        done = subprocess.run(["git", "clone", "--quiet", ROOT, tree], check=False)
        assert done.returncode == 0
        out = folder / name / "dist"
        built = subprocess.run(
            [UV, "build", "--quiet", "--out-dir", out], capture_output=True, text=True, check=False,
            cwd=tree, env={**os.environ, "SOURCE_DATE_EPOCH": "1774310400"},
        )  # fmt: skip
        assert built.returncode == 0, built.stderr
        found.append({each.name: each.read_bytes() for each in out.glob("mapfold-*")})
    assert len(found[0]) == 2
    assert found[0] == found[1]


HELP_OF_ALL = """
from typer.testing import CliRunner
from projections.surfaces.cli import COMMANDS, command_line
program = command_line()
for name in ["", *COMMANDS, "log cat", "db check", "log info", "edit join"]:
    done = CliRunner().invoke(program, [*name.split(), "--help"])
    assert done.exit_code == 0, (name, done.output, done.exception)
"""

DESCRIBED = """
from projections.surfaces.serve.http import create_app
shapes = create_app(None, None).openapi()["components"]["schemas"]
assert "place_id" in shapes["Place"]["properties"], shapes
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    """Not in pytest's own: each new pytest closes that to others, under the feet of the server,
    which runs as another user and loads its extensions from the environment."""
    with tempfile.TemporaryDirectory(prefix="mapfold-test-versions-") as made:
        yield Path(made)


@pytest.mark.timeout(900)
def test_the_oldest_allowed_versions(folder: Path) -> None:
    check(installed(folder, sys.executable, "--resolution", "lowest-direct"), folder)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("version", ["3.12", "3.13", "3.14"])
def test_other_pythons(version: str, folder: Path) -> None:
    python = shutil.which(f"python{version}")
    if version == f"{sys.version_info[0]}.{sys.version_info[1]}" or not python:
        pytest.skip(f"Python {version} is not installed, or runs the other tests")
    if subprocess.run([python, "--version"], capture_output=True, check=False).returncode:
        pytest.skip(f"python{version} is there but does not start")
    check(installed(folder, python), folder)
