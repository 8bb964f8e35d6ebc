"""JSON lines, plain or gzip, from a file or a stream.

One message as some other tool kept it, on its way into a log.

Taking a logger's record apart without re-writing what is inside.

A plain Zenoh logger writes one object a line: ``{"ts": 1740000000.123, "iso": "2025-…Z",
"key": "tb/detections", "payload": …}``. The payload stands there as parsed JSON, or as a string:
the raw text when it was no JSON, in some loggers always, in some as base64. An older logger wrote
``{"ts", "iso", "detections": [ … ]}`` with the bare list its detector published.

A JSON payload is cut out of the line as it stands, so that numbers, spaces, escapes and even what
no JSON parser would give back reach the log as they were.
"""

import binascii
import gzip
import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from json.decoder import JSONDecodeError
from typing import BinaryIO, Protocol

from eventsrc.errors import MapfoldError, MisuseError
from eventsrc.ingest import excess


@dataclass(frozen=True, slots=True)
class Imported:
    """``key`` is None where the source names none. ``logged_ns`` is when the source received the
    message and ``stamp_ns`` when it was published, None where it does not say."""

    payload: bytes
    key: str | None = None
    logged_ns: int | None = None
    stamp_ns: int | None = None


class Source(Protocol):
    """Something to import from."""

    name: str
    unit: str
    """What `at` counts: ``line``, ``message``, ``offset``."""
    at: int | None
    """Where the message that `records` gave last stands."""
    size_bytes: int | None
    skipped: int
    """Messages passed over because they are no JSON by their own declaration."""

    def records(self) -> Iterator[Imported]:
        """The messages in their order."""

    def position(self) -> int:
        """Bytes consumed so far, of ``size_bytes``."""


_DECODER = json.JSONDecoder()
_SPACE = " \t\r\n"
_PAYLOAD_FIELDS = ("payload", "detections")


def read_line(line: bytes) -> Imported:
    """The message in one line: a logger's record, or else the line itself."""
    if b'"ts"' not in line or not any(b'"%s"' % f.encode() in line for f in _PAYLOAD_FIELDS):
        return Imported(line)
    if excess(line, len(line)) is not None:  # too much to take apart; it will be refused as it is
        return Imported(line)
    try:
        fields = {name: (value, text) for name, value, text in _members(line.decode())}
    except (JSONDecodeError, UnicodeDecodeError, RecursionError):
        return Imported(line)
    if "ts" not in fields or "run_id" in fields:
        return Imported(line)
    for name in _PAYLOAD_FIELDS:
        if name in fields:
            key = fields.get("key", (None, ""))[0]
            return Imported(
                _payload(*fields[name]),
                key=key if isinstance(key, str) and key else None,
                logged_ns=_nanoseconds(fields["ts"][1]),
            )
    return Imported(line)


def _members(text: str) -> Iterator[tuple[str, object, str]]:
    """Name, value and source text of each member of a JSON object."""
    at = _skip(text, 0)
    if text[at : at + 1] != "{":
        raise JSONDecodeError("no object", text, at)
    at = _skip(text, at + 1)
    while text[at : at + 1] != "}":
        name, at = _DECODER.raw_decode(text, at)
        at = _skip(text, at)
        if not isinstance(name, str) or text[at : at + 1] != ":":
            raise JSONDecodeError("no member", text, at)
        start = _skip(text, at + 1)
        value, at = _DECODER.raw_decode(text, start)
        yield name, value, text[start:at]
        at = _skip(text, at)
        if text[at : at + 1] == ",":
            at = _skip(text, at + 1)
        elif text[at : at + 1] != "}":
            raise JSONDecodeError("no end of object", text, at)


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at] in _SPACE:
        at += 1
    return at


def _payload(value: object, text: str) -> bytes:
    if not isinstance(value, str):
        return text.encode()
    raw = value.encode("utf-8", "surrogatepass")
    if raw.lstrip()[:1] in (b"{", b"["):
        return raw
    try:
        decoded = binascii.a2b_base64(raw, strict_mode=True)
    except binascii.Error:
        return raw
    return decoded if decoded.lstrip()[:1] in (b"{", b"[") else raw


def _nanoseconds(seconds: str) -> int | None:
    """Exact to the decimal in the file; None where there is no time in bounds."""
    try:
        value = int(Decimal(seconds).scaleb(9).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        return None
    return value if 0 <= value < 2**63 else None


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
