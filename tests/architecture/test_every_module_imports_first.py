"""Any module can be the first that a program imports: no cycle hides behind the usual order."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Each import happens in a fork of a process that has loaded the outside libraries and none of ours.
FORKS = """
import importlib, os, sys, traceback
for library in ("numpy", "pydantic", "psycopg", "psycopg_pool", "zenoh", "mcap.reader", "typer",
                "rich.progress", "fastapi", "matplotlib.figure", "prometheus_client"):
    importlib.import_module(library)
failed = []
for name in sys.argv[1:]:
    child = os.fork()
    if child == 0:
        try:
            importlib.import_module(name)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    if os.waitpid(child, 0)[1] != 0:
        failed.append(name)
sys.exit(" ".join(failed) or 0)
"""


def _modules(package: str) -> list[str]:
    files = sorted((ROOT / package).rglob("*.py"))
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files]
    return [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]


@pytest.mark.parametrize("package", ["eventsrc", "projections"])
def test_every_module_imports_first(package: str) -> None:
    modules = _modules(package)
    assert len(modules) > 30
    done = subprocess.run(
        [sys.executable, "-c", FORKS, *modules], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
