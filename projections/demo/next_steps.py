"""What a user can do next with what the demo leaves, as commands to copy.

They are run by a test. Values are quoted for a POSIX shell.
"""

import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from .folder import DemoFolder
from .mapping import MergeMoment

MAPFOLD = "mapfold"


def commands(
    folder: DemoFolder, merge: MergeMoment | None, db: str | None, vector_db: str | None
) -> Iterator[str]:
    """Lines to paste; comments say what for."""
    if shutil.which(MAPFOLD) is None:
        activate = Path(sys.prefix) / "bin" / "activate"
        yield f"   . {_quoted(_near(activate))}    # puts mapfold on the path"
    if db is None:
        yield f"   export MAPFOLD_HOME={_quoted(folder.path)}    # where the databases are"
    else:
        yield f"   export MAPFOLD_DB={shlex.quote(db)}"
    if vector_db is not None:
        yield f"   export MAPFOLD_VECTOR_DB={shlex.quote(vector_db)}"
    log, settings = _quoted(folder.log), f"--settings {_quoted(folder.settings)}"
    yield f"   mapfold state {log} {settings}"
    if merge is not None:
        yield f"   mapfold diff {log} {merge.offset} {merge.offset + 1} {settings}    # that merge"
        yield f"   mapfold merges {log} {settings}"
    yield f"   mapfold relocalize {_quoted(folder.question(1))}"
    yield f"   mapfold status {log} {settings}"


def _near(path: Path) -> Path:
    """Relative to the current folder where it is inside it: shorter, and easier to read."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _quoted(path: Path) -> str:
    return shlex.quote(os.fspath(path))
