"""Lines of a file: blank ones, the last one, their largest size."""

import io

import pytest

from eventsrc.errors import MisuseError
from eventsrc.importers import json_lines
from eventsrc.importers.json_lines import JsonLines


def payloads(data: bytes) -> list[bytes]:
    return [r.payload for r in JsonLines("f", io.BytesIO(data), len(data), data[:8]).messages()]


def test_blank_lines_are_skipped_and_the_last_needs_no_newline() -> None:
    assert payloads(b"\n {} \r\n\n\t\n[1]\n{") == [b"{}", b"[1]", b"{"]
    assert payloads(b"") == []


def test_a_line_over_the_bound_is_misuse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_lines, "MAX_LINE_BYTES", 10)
    assert payloads(b"123456789\n" * 3) == [b"123456789"] * 3
    with pytest.raises(MisuseError, match="line 2 is longer than 10 bytes"):
        payloads(b"1\n1234567890123\n")
