"""The public names of `projections.history`, and what importing it loads."""

import subprocess
import sys

import projections.history


def test_all_is_sorted_and_complete() -> None:
    names = projections.history.__all__
    assert names == sorted(names)
    assert all(hasattr(projections.history, name) for name in names)


def test_importing_it_loads_no_drawing_and_no_database() -> None:
    code = "import projections.history, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"matplotlib", "psycopg", "zenoh", "typer"} & set(done.stdout.split())
