"""As whom the embedded server runs when we are root: PostgreSQL refuses to be root.

Then it is the system user ``pgserver``, made on first use. That user must be able to *enter* the
folders above the data and the programs: those that forbid it get ``o+x``, which lets nobody list or
read them.
"""

import os
import pwd
import shutil
import stat
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from projections.errors import EmbeddedServerError

SYSTEM_USER: Final = "pgserver"


def server_identity() -> dict[str, Any]:
    """What `subprocess.run` needs to run a program as the server's user; nothing unless root."""
    if os.geteuid() != 0:
        return {}
    _ensure_system_user()
    return {"user": SYSTEM_USER, "group": SYSTEM_USER, "extra_groups": ()}


def _ensure_system_user() -> None:
    try:
        pwd.getpwnam(SYSTEM_USER)
    except KeyError:
        command: Sequence[str] = ("useradd", "--system", "--user-group", SYSTEM_USER)
        try:
            subprocess.run(command, check=True, capture_output=True)  # noqa: S603
        except (OSError, subprocess.CalledProcessError) as error:
            raise EmbeddedServerError(
                f"PostgreSQL does not run as root and the system user {SYSTEM_USER} cannot be made"
                f" ({error}); run mapfold as another user, or give a database with --db"
            ) from None


def give_to_server_user(folder: Path) -> None:
    """Make the server's user the owner of ``folder``."""
    if os.geteuid() == 0:
        _ensure_system_user()
        shutil.chown(folder, SYSTEM_USER, SYSTEM_USER)


def let_server_user_enter(*paths: Path) -> None:
    """Let the server's user pass through every folder above ``paths``."""
    if os.geteuid() != 0:
        return
    for path in paths:
        for parent in path.resolve().parents:
            mode = parent.stat().st_mode
            if not mode & stat.S_IXOTH:
                parent.chmod(mode | stat.S_IXOTH)
