"""A command imports what it calls: other commands' halves and extras are not loaded for it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.thorough import mostly_slow

SAMPLE = Path(__file__).parents[2] / "logs" / "sample"

LOADED = """
import atexit, os, sys
atexit.register(lambda: os.write(2, ' '.join(sys.modules).encode()))
from projections.surfaces.cli import main
main()
"""
ROS = ("eventsrc.ros", "rosbags")
ADAPTERS = ("eventsrc.adapters", "projections.adapters", "onnxruntime", "matplotlib")
NETWORK = ("zenoh", "fastapi", "starlette", "uvicorn")
DATABASES = ("psycopg", "pgserver", "projections.postgres")
WRITERS = ("eventsrc.log.writer", "eventsrc.log.recover", "eventsrc.log.verify")
HELPERS = ("projections.localize", "projections.edit", "projections.surfaces.serve")
IMPORTERS = ("eventsrc.record.importers", "eventsrc.record.recorder")


ALWAYS = (*ROS, *ADAPTERS, *NETWORK, *DATABASES, *HELPERS)


def loaded(folder: Path, *words: str) -> list[str]:
    """The modules that a command has loaded at its end."""
    program = [sys.executable, "-c", LOADED, *words]
    done = subprocess.run(program, capture_output=True, text=True, cwd=folder, check=True)
    return done.stderr.splitlines()[-1].split()


@pytest.mark.parametrize(
    ("words", "unwanted", "most"),
    mostly_slow(
        [
            ("merges sample", (*ALWAYS, *WRITERS), 152),
            ("state sample", (*ALWAYS, *WRITERS), 140),
            ("log info sample", ALWAYS, 130),
            ("path sample 0,0 1,0", (*ROS, *IMPORTERS, *ADAPTERS, *NETWORK, *WRITERS), 124),
        ]
    ),
)
def test_a_command_loads_only_what_it_calls(
    tmp_path: Path, words: str, unwanted: tuple[str, ...], most: int
) -> None:
    shutil.copytree(SAMPLE, tmp_path / "sample")
    found = loaded(tmp_path, *words.split())
    wrong = [m for m in found if any(m == u or m.startswith(f"{u}.") for u in unwanted)]
    assert wrong == []
    ours = [m for m in found if m.partition(".")[0] in ("eventsrc", "projections")]
    assert len(ours) <= most
