"""The system user of the embedded server, and the folder for its socket when paths are too long.

PostgreSQL does not run as root. For root it runs as the system user ``pgserver``, made on first
use. That user must be able to *enter* the folders above the data and the programs: those that
forbid it get ``o+x``, which lets no one list or read them.

The socket folder is in ``/tmp``, where every user may make folders, so no name is trusted:

* It is made under a random name, 0700, so it cannot have been made before.
* Its name is in the file ``pg.socket`` beside the data folder, with the data folder's inode: the
  copy of a home is another server.
* It is used only while it is a folder, no link, that the server's user owns and no one else can
  enter. Else the server gets a new one.
"""

import contextlib
import os
import pwd
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from projections.fold.map_errors import EmbeddedServerError

SYSTEM_USER: Final = "pgserver"


def server_identity() -> dict[str, Any]:
    """Arguments for `subprocess.run` to run a program as the server's user; none unless root."""
    if os.geteuid() != 0:
        return {}
    _ensure_system_user()
    return {"user": SYSTEM_USER, "group": SYSTEM_USER, "extra_groups": ()}


def _ensure_system_user() -> None:
    try:
        pwd.getpwnam(SYSTEM_USER)
    except KeyError:
        command: Sequence[str] = (_useradd(), "--system", "--user-group", SYSTEM_USER)
        try:
            subprocess.run(command, check=True, capture_output=True)  # noqa: S603
        except (OSError, subprocess.CalledProcessError) as error:
            with contextlib.suppress(KeyError):
                pwd.getpwnam(SYSTEM_USER)
                return  # another process has made it meanwhile
            raise EmbeddedServerError(
                f"PostgreSQL does not run as root and the system user {SYSTEM_USER} cannot be made"
                f" ({error}); run mapfold as another user, or give a database with --db"
            ) from None


def _useradd() -> str:
    """The program that makes users, also where the PATH lacks the folders of an administrator's
    programs, as under cron."""
    path = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
    return shutil.which("useradd", path=path) or "useradd"


def server_uid() -> int | None:
    """The user id that the server runs as; None when root has not made that user yet."""
    if os.geteuid() != 0:
        return os.geteuid()
    with contextlib.suppress(KeyError):
        return pwd.getpwnam(SYSTEM_USER).pw_uid
    return None


def server_user() -> str:
    """The name of the user that the server runs as."""
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
    """A descriptor of a folder, relative to ``within``. Raises OSError for a link or no folder."""
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(name, flags, dir_fd=within)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def give_to_server_user(folder: Path) -> None:
    """Make the server's user the owner of ``folder``, which this process has made."""
    if os.geteuid() != 0:
        return
    _ensure_system_user()
    owner = pwd.getpwnam(SYSTEM_USER)
    with open_folder(folder) as descriptor:
        if os.fstat(descriptor).st_uid != 0:
            raise EmbeddedServerError(f"{folder}: another user has made it; remove it")
        os.fchown(descriptor, owner.pw_uid, owner.pw_gid)


def let_server_user_enter(*paths: Path) -> None:
    """Set ``o+x`` on the folders above ``paths`` that the server's user cannot enter."""
    if os.geteuid() != 0:
        return
    for path in paths:
        with contextlib.ExitStack() as opened:
            above = opened.enter_context(open_folder("/"))
            # One by one through descriptors, so that none can be replaced by a link meanwhile.
            for name in path.resolve().parts[1:-1]:
                above = opened.enter_context(open_folder(name, above))
                mode = stat.S_IMODE(os.fstat(above).st_mode)
                if not mode & stat.S_IXOTH:
                    os.fchmod(above, mode | stat.S_IXOTH)


# Not $TMPDIR: it may be long itself.
_PARENT: Final = Path("/tmp")  # noqa: S108 - random names, made 0700, and checked
_PREFIX: Final = "mapfold-"


def find_socket_folder(data: Path) -> Path | None:
    """The socket folder of ``data``; None if there is none that can be trusted."""
    folder = _read_record(data)
    return folder if folder is not None and _is_private(folder) else None


def find_or_make_socket_folder(data: Path) -> Path:
    """The socket folder of ``data``, made if need be: under its last name if that is free, as URLs
    hold it."""
    folder = find_socket_folder(data)
    if folder is None:
        folder = _make_again(_read_record(data)) or Path(
            tempfile.mkdtemp(prefix=_PREFIX, dir=_PARENT)
        )
        give_to_server_user(folder)
        _write_record(data, folder)
    return folder


def _is_private(folder: Path) -> bool:
    try:
        with open_folder(folder) as descriptor:
            status = os.fstat(descriptor)
    except OSError:  # not there, a link, no folder, or not for us to open
        return False
    return status.st_uid == server_uid() and not status.st_mode & 0o077


def _make_again(folder: Path | None) -> Path | None:
    if folder is None:
        return None
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        return None
    return folder


def _read_record(data: Path) -> Path | None:
    with contextlib.suppress(OSError, ValueError):
        inode, name = _record_file(data).read_text("utf-8").split("\n")[:2]
        if int(inode) == data.stat().st_ino and name.startswith(_PREFIX) and "/" not in name:
            return _PARENT / name
    return None


def _write_record(data: Path, folder: Path) -> None:
    record = _record_file(data)
    new = record.with_name(f"{record.name}.new")
    new.unlink(missing_ok=True)
    with new.open("x", encoding="utf-8") as file:
        file.write(f"{data.stat().st_ino}\n{folder.name}\n")
    new.replace(record)


def _record_file(data: Path) -> Path:
    return data.with_name(f"{data.name}.socket")
