"""Import JSON lines, plain or gzip, from a file or a stream: envelopes, records of Zenoh loggers,
and the output of ``mapfold log cat --json``.

A Zenoh logger writes one object a line: ``{"ts": 1740000000.123, "iso": "2025-…Z",
"key": "tb/detections", "payload": …}``. The payload is parsed JSON, or a string: the raw text if it
was no JSON, in some loggers always, in some as base64. An older logger wrote
``{"ts", "iso", "detections": [ … ]}`` with the bare list that its detector published.

``mapfold log cat --json`` writes ``{"offset", "logged_ns", "stamp_ns", "key", "payload"}``; the
payload is parsed JSON, text that is no JSON, or null beside ``payload_base64``. An older envelope
has its ``version`` beside it. Verbatim messages are passed over, because the text of their schema
is missing.

A JSON payload is cut out of the line as it stands, never parsed and written again, so that numbers,
spaces and escapes reach the log unchanged.
"""

import binascii
import codecs
import gzip
import json
import zlib
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from json.decoder import JSONDecodeError
from typing import Any, BinaryIO, TypeGuard

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.envelope.commands import Command
from eventsrc.envelope.dropped_classes import DropClasses
from eventsrc.envelope.ingest import check_cost
from eventsrc.envelope.system_events import COMMAND_KEY, DROP_KEY, MAX_KEPT_BYTES, Excerpt

from .sources import ImportedMessage, Source

_DECODER = json.JSONDecoder()
_SPACE = " \t\r\n"
_PAYLOAD_FIELDS = ("payload", "detections")
_SHOWN_FIELDS = frozenset({"offset", "logged_ns", "stamp_ns", "key", "payload"})
_MAX_NS = 2**63


def command_record(said: Command | DropClasses, stamp_ns: int) -> dict[str, Any]:
    """A command, or that classes are dropped, as a line of ``mapfold log cat --json`` has it: one
    of the first of a file that says this of the log that it is imported into."""
    payload = said.model_dump(mode="json", exclude_none=True)
    times = {"logged_ns": stamp_ns, "stamp_ns": stamp_ns}
    key = DROP_KEY if isinstance(said, DropClasses) else COMMAND_KEY
    return {"offset": 0, **times, "key": key, "payload": payload}


def read_line(line: bytes) -> ImportedMessage:
    """The message in one line: the payload if the line is a record, else the line itself."""
    if b'"ts"' not in line and b'"logged_ns"' not in line:
        return ImportedMessage(line)
    if not any(b'"%s"' % f.encode() in line for f in _PAYLOAD_FIELDS):
        return ImportedMessage(line)
    if check_cost(line, len(line)) is not None:  # too costly to parse; validation will reject it
        return ImportedMessage(line)
    try:
        fields = {name: (value, text) for name, value, text in _members(line.decode())}
    except (JSONDecodeError, UnicodeDecodeError, RecursionError):
        return ImportedMessage(line)
    if "run_id" in fields:
        return ImportedMessage(line)
    if fields.keys() >= _SHOWN_FIELDS:
        return _shown_event(line, fields)
    if "ts" not in fields:
        return ImportedMessage(line)
    for name in _PAYLOAD_FIELDS:
        if name in fields:
            key = fields.get("key", (None, ""))[0]
            return ImportedMessage(
                _payload(*fields[name]),
                key=key if isinstance(key, str) and key else None,
                logged_ns=_nanoseconds(fields["ts"][1]),
            )
    return ImportedMessage(line)


def _shown_event(line: bytes, fields: dict[str, tuple[object, str]]) -> ImportedMessage:
    """The message in a line of `mapfold log cat --json`. If a field is of another type it is the
    line itself, which validation then rejects."""
    values = {name: value for name, (value, _) in fields.items()}
    key, logged_ns, stamp_ns = values["key"], values["logged_ns"], values["stamp_ns"]
    if not (isinstance(key, str) and key and _is_time(logged_ns) and _is_time(stamp_ns)):
        return ImportedMessage(line)
    if "encoding" in fields:
        what = f"{values['encoding']} {values.get('schema') or ''}".strip()
        return ImportedMessage(b"", key, unread=f"{what}, without the schema's text")
    payload, encoded = values["payload"], values.get("payload_base64")
    if isinstance(encoded, str):
        try:
            raw = binascii.a2b_base64(encoded, strict_mode=True)
        except binascii.Error:
            return ImportedMessage(line)
    elif isinstance(payload, str):
        raw = payload.encode("utf-8", "surrogatepass")
    else:
        raw = fields["payload"][1].encode()
    version = values.get("version")
    version = version if type(version) is int else None
    return ImportedMessage(raw, key, logged_ns, stamp_ns, version)


def _is_time(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 <= value < _MAX_NS


def _members(text: str) -> Iterator[tuple[str, object, str]]:
    """Name, value and source text of each member of a JSON object."""
    at = _skip_spaces(text, 0)
    if text[at : at + 1] != "{":
        raise JSONDecodeError("no object", text, at)
    at = _skip_spaces(text, at + 1)
    while text[at : at + 1] != "}":
        name, at = _DECODER.raw_decode(text, at)
        at = _skip_spaces(text, at)
        if not isinstance(name, str) or text[at : at + 1] != ":":
            raise JSONDecodeError("no member", text, at)
        start = _skip_spaces(text, at + 1)
        value, at = _DECODER.raw_decode(text, start)
        yield name, value, text[start:at]
        at = _skip_spaces(text, at)
        if text[at : at + 1] == ",":
            at = _skip_spaces(text, at + 1)
        elif text[at : at + 1] != "}":
            raise JSONDecodeError("no end of object", text, at)


def _skip_spaces(text: str, at: int) -> int:
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
    """A decimal text of seconds as exact int nanoseconds; None if it does not fit int64."""
    try:
        value = int(Decimal(seconds).scaleb(9).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        return None
    return value if 0 <= value < _MAX_NS else None


MAX_LINE_BYTES = 4 * 1024 * 1024 * 1024
"""A longer line ends the import: the file has no lines, such as a stream of zeros without end."""
_PIECE_BYTES = 1024 * 1024
GZIP_MAGIC = b"\x1f\x8b"


class JsonLines(Source):
    """One message a line; blank lines are skipped, and so is a byte order mark at the start.
    Gzip is recognised by its first bytes."""

    unit = "line"

    def __init__(self, name: str, file: BinaryIO, size_bytes: int | None, start: bytes) -> None:
        super().__init__(name, size_bytes)
        self._file = file
        self._compressed = start.startswith(GZIP_MAGIC)

    def bytes_read(self) -> int:
        """Bytes of the file read."""
        return self._file.tell() if self._compressed and self.size_bytes else self._read

    def messages(self) -> Iterator[ImportedMessage]:
        """The messages, line by line."""
        stream: BinaryIO = (
            gzip.GzipFile(fileobj=self._file) if self._compressed else self._file  # type: ignore[assignment]
        )
        number = 0
        try:
            while line := stream.readline(MAX_KEPT_BYTES + 1):
                number += 1
                self._read += len(line)
                if len(line) > MAX_KEPT_BYTES and not line.endswith(b"\n"):
                    self.at = number
                    yield self._too_long(number, line, stream)
                    continue
                if number == 1:
                    line = line.removeprefix(codecs.BOM_UTF8)
                if line := line.strip(b" \t\r\n"):
                    self.at = number
                    yield read_line(line)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise MapfoldError(
                f"{self.name}: the gzip data is torn after line {number}: {error}; "
                "the lines before it are in the log"
            ) from None

    def _too_long(self, number: int, start: bytes, stream: BinaryIO) -> ImportedMessage:
        """The refusal of a line that is too large to be read, of which ``start`` was read."""
        excerpt = Excerpt.of(self._pieces(number, start, stream))
        return ImportedMessage(b"", refused=excerpt.reason(), excerpt=excerpt)

    def _pieces(self, number: int, start: bytes, stream: BinaryIO) -> Iterator[bytes]:
        """The rest of a line, without the byte that ends it."""
        size = len(start)
        yield start
        while piece := stream.readline(_PIECE_BYTES):
            size += len(piece)
            self._read += len(piece)
            if size > MAX_LINE_BYTES:
                raise MisuseError(
                    f"{self.name}: line {number} is longer than {MAX_LINE_BYTES:,} bytes; "
                    "are these JSON lines, one envelope a line?"
                )
            yield piece.removesuffix(b"\n")
            if piece.endswith(b"\n"):
                return
