"""Find sites: the subfolders of a folder that hold a log, or the lines of a list."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from eventsrc.base.errors import LogError, LogNotFound, MisuseError, NotALog
from eventsrc.base.text import counted, visible
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.log.sealed_end import segments_of

MAX_LIST_BYTES: Final = 16 * 1024 * 1024
MAX_NAME_BYTES: Final = 255
"""Most bytes of a folder's name in a file system. A database's name has fewer
(`site_databases`)."""
_SHOWN: Final = 8
_SHOWN_OF_NAME: Final = 60

Note = Callable[[str], None]
"""Receives one line of text for people."""


@dataclass(frozen=True, slots=True)
class Site:
    """A name and the folder of a log, which need not be readable."""

    name: str
    log: Path


def find_sites(place: Path, note: Note) -> list[Site]:
    """The sites of a folder, by name, or of a list, in its order. Raises MisuseError.

    In a folder each subfolder with a log is a site; ``note`` gets a line that names the others. One
    that cannot be read counts as a site, so that it is reported and not left out.
    """
    try:
        found = _listed(place) if place.is_file() else _in_folder(place, note)
    except OSError as error:
        raise MisuseError(
            f"{place}: {error.strerror or error}; give a folder with one log in each subfolder, or"
            " a file with a line NAME PATH for each log"
        ) from None
    if not found:
        raise MisuseError(
            f"{place}: no log in it; give a folder with one log in each subfolder, or a file with a"
            " line NAME PATH for each log"
        )
    return found


def _in_folder(folder: Path, note: Note) -> list[Site]:
    with os.scandir(folder) as entries:
        names = sorted(e.name for e in entries if not e.name.startswith(".") and _may_be_folder(e))
    if _holds_log(folder):
        raise MisuseError(
            f"{folder} is one log; give the folder above it, with one log in each subfolder, or"
            " use the command without `fleet`"
        )
    caches = {f"{name}.history" for name in names}
    sites, others = [], []
    for name in names:
        if _holds_log(folder / name):
            check_name(name, str(folder / name))
            sites.append(Site(name, folder / name))
        elif name not in caches:
            others.append(name)
    if others:
        shown = ", ".join(map(visible, others[:_SHOWN])) + (", …" if len(others) > _SHOWN else "")
        note(f"{folder}: {counted(len(others), 'subfolder')} without a log left out: {shown}")
    return sites


def _may_be_folder(entry: "os.DirEntry[str]") -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link to itself, for example, which is then named as left out
        return True


def _holds_log(folder: Path) -> bool:
    """Whether there are segments, or the folder cannot be read."""
    try:
        return bool(segments_of(folder))
    except (LogNotFound, NotALog):
        return False
    except LogError:  # it may not be read
        return True


def _listed(file: Path) -> list[Site]:
    try:
        data = read_file(file, MAX_LIST_BYTES)
    except FileFault as fault:
        raise MisuseError(f"{file}: {fault}; is it a list of logs?") from None
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise MisuseError(
            f"{file}: not UTF-8 at byte {error.start}; give a text file with a line NAME PATH for"
            " each log, or a folder"
        ) from None
    first: dict[str, int] = {}
    sites = []
    for number, site in _sites_of(lines, file):
        if site.name in first:
            raise MisuseError(
                f"{file}: lines {first[site.name]} and {number} both name the site {site.name!r};"
                " give each a name of its own: NAME PATH"
            )
        first[site.name] = number
        sites.append(site)
    return sites


def _sites_of(lines: list[str], file: Path) -> Iterator[tuple[int, Site]]:
    for number, line in enumerate(lines, start=1):
        words = line.strip().split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        where = f"{file}, line {number}"
        path = file.parent / words[-1]  # an absolute path stays as it is
        # Without resolving links: the name that was written is the site's.
        name = words[0] if len(words) == 2 else Path(os.path.normpath(path)).name
        check_name(name, where)
        if "\0" in words[-1]:
            raise MisuseError(f"{where}: a path cannot have a NUL; write the line as NAME PATH")
        yield number, Site(name, path)


def check_name(name: str, where: str) -> None:
    """Raise MisuseError for an invalid name of a site: a path, control characters, bytes that are
    no text."""
    size = len(name.encode("utf-8", "surrogateescape"))
    if (
        not name.isprintable()
        or not name
        or "/" in name
        or name in (".", "..")
        or size > MAX_NAME_BYTES
    ):
        raise MisuseError(
            f"{visible(where)}: {_excerpt(name)!r} cannot be a site's name, which is printable text"
            f" without / of at most {MAX_NAME_BYTES} bytes; name it in a list: NAME PATH"
        )


def _excerpt(name: str) -> str:
    """``name``, or the beginning of a long one, such as a line of a file that is no list."""
    return name if len(name) <= _SHOWN_OF_NAME else f"{name[:_SHOWN_OF_NAME]}…"
