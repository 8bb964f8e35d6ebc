"""Lines of a file: blank ones, the last one, their largest size."""

import hashlib
import io

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.record.importers import json_lines
from eventsrc.record.importers.json_lines import JsonLines


def payloads(data: bytes) -> list[bytes]:
    return [r.payload for r in JsonLines("f", io.BytesIO(data), len(data), data[:8]).messages()]


def test_blank_lines_are_skipped_and_the_last_needs_no_newline() -> None:
    assert payloads(b"\n {} \r\n\n\t\n[1]\n{") == [b"{}", b"[1]", b"{"]
    assert payloads(b"") == []


@pytest.mark.parametrize("size", [9, 10, 11, 15, 16])
def test_of_a_line_over_the_bound_an_excerpt_is_kept(
    monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(json_lines, "MAX_KEPT_BYTES", 10)
    monkeypatch.setattr(json_lines, "_PIECE_BYTES", 5)
    long = b"1234567890abcdef"[:size]
    for end in (b"\n", b"\n2", b""):
        data = b"1\n" + long + end
        first, second, *others = JsonLines("f", io.BytesIO(data), len(data), data[:8]).messages()
        assert (first.payload, [other.payload for other in others]) == (
            b"1",
            [b"2"][: len(end) - 1],
        )
        if size <= 10:
            assert (second.payload, second.excerpt) == (long, None)
        else:
            sha256 = hashlib.sha256(long).hexdigest()
            assert second.excerpt == (long, size, sha256)


def test_a_line_that_may_have_no_end_is_misuse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_lines, "MAX_KEPT_BYTES", 5)
    monkeypatch.setattr(json_lines, "MAX_LINE_BYTES", 10)
    with pytest.raises(MisuseError, match="line 2 is longer than 10 bytes"):
        payloads(b"1\n1234567890123\n")
