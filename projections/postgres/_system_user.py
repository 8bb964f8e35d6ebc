"""As whom the embedded server runs when we are root: PostgreSQL refuses to be root.

Then it is the system user ``pgserver``, made on first use. That user must be able to *enter* the
folders above the data and the programs: those that forbid it get ``o+x``, which lets nobody list or
read them.
"""

import contextlib
import os
import pwd
import stat
import subprocess
from collections.abc import Iterator, Sequence
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


def server_uid() -> int | None:
    """The user id that the server runs under; None when root has not made its user yet."""
    if os.geteuid() != 0:
        return os.geteuid()
    with contextlib.suppress(KeyError):
        return pwd.getpwnam(SYSTEM_USER).pw_uid
    return None


def server_user() -> str:
    """The name of that user."""
    if os.geteuid() == 0:
        return SYSTEM_USER
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        raise EmbeddedServerError(
            f"the user id {os.geteuid()} has no name on this system, and PostgreSQL does not run"
            " without one; run mapfold as another user, or give a database with --db"
        ) from None


@contextlib.contextmanager
def open_folder(name: Path | str, within: int | None = None) -> Iterator[int]:
    """A descriptor of a folder. Raises OSError when it is a link or no folder."""
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(name, flags, dir_fd=within)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def give_to_server_user(folder: Path) -> None:
    """Make the server's user the owner of ``folder``, which we have made."""
    if os.geteuid() != 0:
        return
    _ensure_system_user()
    owner = pwd.getpwnam(SYSTEM_USER)
    with open_folder(folder) as descriptor:
        if os.fstat(descriptor).st_uid != 0:
            raise EmbeddedServerError(f"{folder}: somebody else has made it; remove it")
        os.fchown(descriptor, owner.pw_uid, owner.pw_gid)


def let_server_user_enter(*paths: Path) -> None:
    """Let the server's user pass through every folder above ``paths``."""
    if os.geteuid() != 0:
        return
    for path in paths:
        with contextlib.ExitStack() as opened:
            above = opened.enter_context(open_folder("/"))
            # One by one, so that none can become a link meanwhile.
            for name in path.resolve().parts[1:-1]:
                above = opened.enter_context(open_folder(name, above))
                mode = stat.S_IMODE(os.fstat(above).st_mode)
                if not mode & stat.S_IXOTH:
                    os.fchmod(above, mode | stat.S_IXOTH)
