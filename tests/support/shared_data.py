"""The trial data beside the repository. Where its folder is absent, tests that need it skip and say
so; anything else that is wrong with it fails them."""

import gzip
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("MAPFOLD_SHARED_DATA", ROOT.parent / "shared" / "data"))
WORLDS = Path(os.environ.get("MAPFOLD_SHARED_WORLDS", ROOT.parent / "shared" / "worlds"))


def skip_without(folder: Path, variable: str) -> None:
    """Skip the test where a folder of trial data, which ``variable`` may name, is absent."""
    if not folder.is_dir():
        pytest.skip(f"the trial data {folder} is absent; set {variable} to its folder")


def shared_run_path(name: str) -> Path:
    """The file of a run such as ``house-a``; skips the test without the trial data."""
    skip_without(DATA, "MAPFOLD_SHARED_DATA")
    return DATA / name.partition("-")[0] / f"{name}.jsonl.gz"


def shared_run(name: str) -> list[bytes]:
    """The payloads of a run such as ``house-a``; skips the test without the trial data."""
    with gzip.open(shared_run_path(name)) as lines:
        return lines.read().splitlines()
