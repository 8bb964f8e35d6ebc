"""The trial data beside the repository. Tests that use it say what is missing when it is."""

import gzip
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ.get("MAPFOLD_SHARED_DATA", ROOT.parent / "shared" / "data"))


def shared_run(name: str) -> list[bytes]:
    """The payloads of a run such as ``house-a``; skips the test when they are not there."""
    path = DATA / name.partition("-")[0] / f"{name}.jsonl.gz"
    if not path.exists():
        pytest.skip(f"the trial run {path} is absent; set MAPFOLD_SHARED_DATA to its folder")
    with gzip.open(path) as lines:
        return lines.read().splitlines()
