"""Any module can be the first that a program imports: no cycle hides behind the usual order."""

import subprocess
import sys
from pathlib import Path

from tests.support.thorough import rounds, stride

ROOT = Path(__file__).parents[2]

# Each import happens in a fork of a process that has loaded the outside libraries and none of ours.
FORKS = """
import contextlib, gc, importlib, os, sys, traceback
read, write = os.pipe()
if os.fork() == 0:  # finds out which outside modules all of ours load
    for name in sys.argv[1:]:
        importlib.import_module(name)
    ours = ("eventsrc", "projections", "__main__")
    os.write(write, " ".join(m for m in sys.modules if not m.startswith(ours)).encode())
    os._exit(0)
os.close(write)
for name in os.fdopen(read).read().split():
    with contextlib.suppress(ImportError):  # names that exist only once their parent has made them
        importlib.import_module(name)
gc.collect()
gc.disable()
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
    """Modules, packages first: there an import of one starts that of many."""
    files = sorted((ROOT / package).rglob("*.py"), key=lambda f: (f.name != "__init__.py", f))
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files]
    return [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]


def test_every_module_imports_first() -> None:
    chosen = []
    for package in ("eventsrc", "projections")[: rounds(2, 1)]:
        modules = _modules(package)
        assert len(modules) > 30
        packages = sum((ROOT / name.replace(".", "/")).is_dir() for name in modules)
        chosen += [*modules[: packages : stride(8)], *modules[packages :: stride(50)]]
    done = subprocess.run(
        [sys.executable, "-c", FORKS, *chosen], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
