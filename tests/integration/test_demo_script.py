"""scripts/demo, called from anywhere: paths are those of the caller."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.docs.console import ROOT
from tests.support.commands import Commands

_STUB = '#!/bin/sh\necho "$PWD"\necho "$@"\n'


@pytest.fixture
def repo(tmp_path: Path) -> Path:
    """A repository whose virtual environment is up to date, with a `mapfold` that tells what it
    was asked."""
    repo = tmp_path / "repo"
    (repo / "scripts").mkdir(parents=True)
    for name in ("demo", "_venv.sh"):
        shutil.copy(ROOT / "scripts" / name, repo / "scripts" / name)
    (repo / "pyproject.toml").write_text("")
    bin_ = repo / ".venv" / "bin"
    bin_.mkdir(parents=True)
    for name in ("python", "mapfold"):
        (bin_ / name).write_text(_STUB)
        (bin_ / name).chmod(0o755)
    checksum = subprocess.run(["cksum", repo / "pyproject.toml"], capture_output=True, text=True)
    (repo / ".venv" / ".installed-run").write_text(checksum.stdout.split()[0] + "\n")
    return repo


def _told(repo: Path, cwd: Path, *arguments: str) -> list[str]:
    script = repo / "scripts" / "demo"
    done = subprocess.run([script, *arguments], cwd=cwd, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_in_the_repository(repo: Path) -> None:
    assert _told(repo, repo, "--json") == [str(repo), "demo --json"]


def test_from_another_folder(repo: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    default = f"demo --out {repo}/logs/demo"
    assert _told(repo, elsewhere, "--out", "x") == [str(elsewhere), f"{default} --out x"]
    assert _told(repo, elsewhere) == [str(elsewhere), default]


def test_of_two_folders_the_last_one_counts(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said = Commands.in_folder(tmp_path)("demo", "--out", "never", "--out", "file", code=2)
    assert said.err.startswith("mapfold: file: ")
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
