"""Whether what was made from a log's segments is still of this log: `same_but_sealed`."""

import shutil
from pathlib import Path

import pytest

from eventsrc.envelope.model import Offset
from eventsrc.log import (
    LogReader,
    LogWriter,
    log_identity,
    parse_fsync,
    same_but_sealed,
    segment_signatures,
)
from eventsrc.record.append import append_payload
from projections.map.fold import fold_log
from projections.store.history_recorder import map_after
from tests.property.test_timeline_cache import kept_early
from tests.support.envelopes import envelope, payload
from tests.support.histories import RULES
from tests.support.walks import write_log


def documents(first: int, last: int, step: float) -> list[dict[str, object]]:
    return [envelope(n, step * n, 0.0) for n in range(first, last)]


def begun(log: Path, last: int, step: float) -> LogWriter:
    """A writer that has recorded the keyframes from 12 on, in a segment that it has not sealed."""
    writer = LogWriter(log, fsync=parse_fsync("never"))
    for document in documents(12, last, step):
        append_payload(writer, "tb/detections", payload(document))
    writer.sync()
    return writer


def test_sealing_and_growing_change_nothing(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", documents(0, 12, 0.5))
    with begun(log, 20, 0.5):
        before = segment_signatures(log, Offset(20))
        assert len(before) == 2
    assert segment_signatures(log, Offset(20)) != before
    assert same_but_sealed(before, segment_signatures(log, Offset(20)))
    write_log(log, documents(20, 25, 0.5))
    assert same_but_sealed(before, segment_signatures(log, Offset(20)))
    assert not same_but_sealed(before, segment_signatures(log, Offset(25)))


def test_a_segment_of_an_unreadable_head_is_not_the_one_it_was(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", documents(0, 12, 0.5))
    before = segment_signatures(log, Offset(12))
    (segment,) = log.glob("*.mcap")
    data = bytearray(segment.read_bytes())
    data[40:60] = bytes(20)
    segment.write_bytes(data)
    assert not same_but_sealed(before, segment_signatures(log, Offset(12)))


def test_a_history_of_a_log_put_back_from_a_copy_and_recorded_on(tmp_path: Path) -> None:
    """The segment that was growing is there again, under the same name, with other events."""
    log = write_log(tmp_path / "log", documents(0, 12, 0.5))
    shutil.copytree(log, tmp_path / "copy")
    with kept_early(), begun(log, 30, 0.5), LogReader(log) as reader:
        map_after(reader, RULES)
    shutil.rmtree(log)
    shutil.copytree(tmp_path / "copy", log)
    notes: list[str] = []
    with kept_early(), begun(log, 35, 0.2), LogReader(log) as reader:
        counts = map_after(reader, RULES, note=notes.append).counts()
        assert counts == fold_log(reader, RULES)[1].counts()
    assert ["the log has lost events since it was made" in note for note in notes] == [True]


def test_a_segment_that_is_sealed_while_the_signatures_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_log(tmp_path / "log", documents(0, 12, 0.5))
    writer = begun(log, 20, 0.5)
    list_growing = log_identity.list_growing

    def listed_then_sealed(path: Path) -> object:
        found = list_growing(path)
        writer.close()
        return found

    monkeypatch.setattr(log_identity, "list_growing", listed_then_sealed)
    assert " sealed " in segment_signatures(log, Offset(20))[1]
