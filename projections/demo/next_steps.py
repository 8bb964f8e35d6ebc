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
    if db is not None or vector_db is not None:  # a URL may hold a password: not said here
        yield "   # and MAPFOLD_DB, MAPFOLD_VECTOR_DB set to what --db and --vector-db were given"
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
