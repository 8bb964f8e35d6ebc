"""JSON lines, plain or gzip, from a file or a stream."""

import gzip
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from eventsrc.errors import MapfoldError, MisuseError

from .logger_record import read_line
from .record import Imported

MAX_LINE_BYTES = 64 * 1024 * 1024
GZIP_MAGIC = b"\x1f\x8b"


class JsonLines:
    """One message a line; blank lines are nothing. Gzip is known by its first bytes."""

    def __init__(self, name: str, file: BinaryIO, size_bytes: int | None, start: bytes) -> None:
        self.name = name
        self.unit = "line"
        self.at: int | None = None
        self.size_bytes = size_bytes
        self.skipped = 0
        self._file = file
        self._compressed = start.startswith(GZIP_MAGIC)
        self._read = 0

    def position(self) -> int:
        """Bytes of the file consumed."""
        return self._file.tell() if self._compressed and self.size_bytes else self._read

    def records(self) -> Iterator[Imported]:
        """The messages, line by line."""
        stream: BinaryIO = (
            gzip.GzipFile(fileobj=self._file) if self._compressed else self._file  # type: ignore[assignment]
        )
        number = 0
        try:
            while line := stream.readline(MAX_LINE_BYTES + 1):
                number += 1
                self._read += len(line)
                self._check_length(number, line)
                if line := line.strip(b" \t\r\n"):
                    self.at = number
                    yield read_line(line)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise MapfoldError(
                f"{self.name}: the gzip data is torn after line {number}: {error}; "
                "the lines before it are in the log"
            ) from None

    def _check_length(self, number: int, line: bytes) -> None:
        if len(line) > MAX_LINE_BYTES:
            raise MisuseError(
                f"{self.name}: line {number} is longer than {MAX_LINE_BYTES} bytes; "
                "are these JSON lines, one envelope a line?"
            )
