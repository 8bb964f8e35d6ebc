"""The page's own files, read into memory once: what is not among them cannot be asked for."""

import hashlib
import mimetypes
from pathlib import Path
from typing import Final, NamedTuple

_FOLDER: Final = Path(__file__).with_name("static")
_TYPES: Final = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_NO_PAGE: Final = b"""<!doctype html><meta charset="utf-8"><title>mapfold</title>
<p>The page is not built in this installation; its interface answers below /api/.</p>
"""


class StaticFile(NamedTuple):
    """A file as it is sent."""

    content: bytes
    media_type: str
    etag: str


def static_files(folder: Path = _FOLDER) -> dict[str, StaticFile]:
    """The files by URL path; ``/`` is index.html."""
    found = {
        f"/{path.relative_to(folder).as_posix()}": _read(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }
    found["/"] = found.get("/index.html") or _static(_NO_PAGE, "text/html")
    return found


def _read(path: Path) -> StaticFile:
    guessed = _TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    return _static(path.read_bytes(), guessed or "application/octet-stream")


def _static(content: bytes, media_type: str) -> StaticFile:
    return StaticFile(content, media_type, f'"{hashlib.sha256(content).hexdigest()[:16]}"')
