"""A folder for the server's socket, when the path of the data folder is too long for one.

It stands in the temporary directory, where everybody may make folders, so no name is trusted:

* It is made under a random name, 0700, so nobody can have made it before.
* Its name is kept beside the data folder, in ``pg.socket``, for later commands to find, together
  with the data folder's inode: the copy of a home is another server.
* It is used only while it is a folder, no link, that the server's user owns and nobody else can
  enter. Else the server gets a new one.
"""

import contextlib
import os
import tempfile
from pathlib import Path
from typing import Final

from ._system_user import give_to_server_user, open_folder, server_uid

# Not $TMPDIR: it may be long itself.
_PARENT: Final = Path("/tmp")  # noqa: S108 - random names, made 0700, and checked
_PREFIX: Final = "mapfold-"


def find(data: Path) -> Path | None:
    """The folder of the server of ``data``; None if there is none that can be trusted."""
    folder = _recorded(data)
    return folder if folder is not None and _is_private(folder) else None


def find_or_make(data: Path) -> Path:
    """The same, making one if need be; under its last name, if that is free, as URLs hold it."""
    folder = find(data)
    if folder is None:
        folder = _made_again(_recorded(data)) or Path(tempfile.mkdtemp(prefix=_PREFIX, dir=_PARENT))
        give_to_server_user(folder)
        _record(data, folder)
    return folder


def _is_private(folder: Path) -> bool:
    try:
        with open_folder(folder) as descriptor:
            status = os.fstat(descriptor)
    except OSError:  # not there, a link, no folder, or not for us to open
        return False
    return status.st_uid == server_uid() and not status.st_mode & 0o077


def _made_again(folder: Path | None) -> Path | None:
    if folder is None:
        return None
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        return None
    return folder


def _recorded(data: Path) -> Path | None:
    with contextlib.suppress(OSError, ValueError):
        inode, name = _record_of(data).read_text("utf-8").split("\n")[:2]
        if int(inode) == data.stat().st_ino and name.startswith(_PREFIX) and "/" not in name:
            return _PARENT / name
    return None


def _record(data: Path, folder: Path) -> None:
    record = _record_of(data)
    written = record.with_name(f"{record.name}.new")
    written.unlink(missing_ok=True)
    with written.open("x", encoding="utf-8") as file:
        file.write(f"{data.stat().st_ino}\n{folder.name}\n")
    written.replace(record)


def _record_of(data: Path) -> Path:
    return data.with_name(f"{data.name}.socket")
