"""Objects in a store: a bucket of S3, Google Cloud or Azure, or a folder, named by a URL.

    s3://BUCKET/PREFIX   gs://BUCKET/PREFIX   az://CONTAINER/PREFIX   file:///FOLDER

The library is obstore (Rust `object_store`). It finds credentials, region and endpoint by itself,
in the environment and as the vendors' tools do; a URL with credentials is refused, since URLs are
printed and kept. Requests that a store answers with a fault of its own are repeated for half a
minute. What fails then is one line, without the query of a URL, which may be signed.
"""

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

from .errors import ArchiveError, MisuseError, NoSuchObject

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

SCHEMES: Final = ("s3", "gs", "az", "file")
_URL: Final = re.compile(rf"(?:{'|'.join(SCHEMES)})://")
_BLOCK: Final = 1024 * 1024
_CLIENT: Final["ClientConfig"] = {
    "connect_timeout": timedelta(seconds=10),
    "read_timeout": timedelta(seconds=60),
    "timeout": timedelta(hours=1),  # of a whole object on a slow line; the library's is 30 s
}
_RETRIES: Final["RetryConfig"] = {
    "max_retries": 6,
    "retry_timeout": timedelta(seconds=30),
    "backoff": {
        "init_backoff": timedelta(milliseconds=100),
        "max_backoff": timedelta(seconds=5),
        "base": 2,
    },
}


def is_store_url(text: str) -> bool:
    """Whether ``text`` names a store, and not a path."""
    return _URL.match(text) is not None


class ObjectStore:
    """The objects under a URL. Its methods raise ArchiveError, and NoSuchObject for an object that
    is not there. With ``make`` a missing folder is made.
    """

    def __init__(self, url: str, *, make: bool = False) -> None:
        self.url = url.rstrip("/")
        self._folder: Path | None = None
        parts = urlsplit(self.url)
        if not is_store_url(url) or "@" in parts.netloc or parts.query or parts.fragment:
            raise MisuseError(
                f"{_without_secrets(url)}: name an archive by s3://BUCKET/PREFIX, gs://…, az://… or"
                " file:///FOLDER, without credentials: those come from the environment"
            )
        if parts.scheme == "file":
            self._folder = _folder(url, parts.netloc, parts.path)
            if not make and not self._folder.is_dir():
                raise NoSuchObject(f"{self.url}: there is no such folder; check the URL")
        try:
            import obstore
            from obstore import exceptions, store
        except ImportError as error:
            raise MisuseError(
                f"obstore is not installed ({error}), which reads and writes archives: "
                "pip install 'mapfold[archive]'"
            ) from None
        self._library, self._errors = obstore, exceptions
        with self._told(""):
            self._store: Any = (
                store.from_url(self.url, client_options=_client(), retry_config=_RETRIES)
                if self._folder is None
                else store.LocalStore(self._folder, mkdir=make)
            )

    def __repr__(self) -> str:
        return f"<ObjectStore {self.url}>"

    def put_new(self, name: str, content: bytes | Path) -> bool:
        """Put an object that does not exist, durably; False, and nothing is changed, if it does."""
        with self._told(name):
            try:
                self._library.put(self._store, name, content, mode="create")
            except self._errors.AlreadyExistsError:
                return False
            self._sync(name)
        return True

    def replace(self, name: str, content: bytes) -> None:
        """Put an object in the place of one that may exist."""
        with self._told(name):
            self._library.put(self._store, name, content, mode="overwrite")
            self._sync(name)

    def read(self, name: str) -> bytes:
        """An object of moderate size."""
        return b"".join(self.blocks(name))

    def blocks(self, name: str) -> Iterator[bytes]:
        """The bytes of an object, about a megabyte at a time."""
        with self._told(name):
            for block in self._library.get(self._store, name).stream(_BLOCK):
                yield bytes(block)

    def sha256(self, name: str) -> tuple[int, str]:
        """Size and SHA-256 of an object, of which every byte is read."""
        size, digest = 0, hashlib.sha256()
        for block in self.blocks(name):
            size += len(block)
            digest.update(block)
        return size, digest.hexdigest()

    def part(self, name: str, start: int, end: int) -> bytes:
        """Bytes ``start`` to before ``end`` of an object."""
        with self._told(name):
            return bytes(self._library.get_range(self._store, name, start=start, end=end))

    def sizes(self, prefix: str) -> dict[str, int]:
        """Name and size of each object under ``prefix``, sorted."""
        with self._told(prefix):
            found = {
                each["path"]: each["size"]
                for batch in self._library.list(self._store, prefix)
                for each in batch
            }
        return {name: found[name] for name in sorted(found)}

    def delete(self, name: str) -> None:
        """Delete an object, which may be missing."""
        with contextlib.suppress(NoSuchObject), self._told(name):
            self._library.delete(self._store, name)
            if self._folder is not None:
                _sync((self._folder / name).parent)

    def _sync(self, name: str) -> None:
        """Bring an object in a folder to the disk, which the library leaves to the system."""
        if self._folder is not None:
            path = self._folder / name
            for each in (path, *path.parents):
                _sync(each)
                if each == self._folder:
                    break

    @contextlib.contextmanager
    def _told(self, name: str) -> Iterator[None]:
        """What the library raises as an ArchiveError."""
        place = f"{self.url}/{name}" if name else self.url
        try:
            yield
        except FileNotFoundError:
            raise NoSuchObject(
                f"{place}: there is no such object or bucket; check the URL"
            ) from None
        except (self._errors.PermissionDeniedError, self._errors.UnauthenticatedError) as error:
            raise ArchiveError(
                f"{place}: the store refuses access: {_reason(error)}; check the credentials in the"
                " environment and their rights"
            ) from None
        except (self._errors.BaseError, OSError, ValueError) as error:
            raise ArchiveError(
                f"{place}: {_reason(error)}; nothing is lost here: run it again"
            ) from None


def _client() -> "ClientConfig":
    """Our timeouts; giving any makes the library forget whether HTTP without TLS is allowed."""
    is_allowed = (f"{each}_ALLOW_HTTP" for each in ("AWS", "GOOGLE", "AZURE"))
    return {**_CLIENT, "allow_http": any(os.environ.get(n, "") == "true" for n in is_allowed)}


def _folder(url: str, host: str, path: str) -> Path:
    if host not in ("", "localhost") or not path:
        raise MisuseError(f"{url}: a folder is named with three slashes: file:///FOLDER")
    return Path(unquote(path))


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _reason(error: Exception) -> str:
    """The first line of an error, without the queries of URLs."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return _without_secrets(text.strip().partition("\n")[0])


def _without_secrets(text: str) -> str:
    return re.sub(r"//[^/\s]*@", "//…@", re.sub(r"\?\S+", "?…", text))
