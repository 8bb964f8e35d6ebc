"""mapfold's own events of a log, as a page marks them: how many are kept and counted."""

from pathlib import Path

import pytest

from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY, RejectedPayload
from eventsrc.log import NEVER, LogReader, LogWriter
from projections.fold.settings import Settings
from projections.surfaces.ui import log_map
from projections.surfaces.ui.log_events import LogEvents
from projections.surfaces.ui.log_map import LogMap, Opened, PrefixReader
from tests.support.envelopes import envelope, payload
from tests.support.logs import walk, write_log

LOSS = payload({"publisher": "p", "first": 1, "last": 3, "count": 3, "cause": "queue_full"})
JUNK = RejectedPayload.encode("k", "no JSON", b"?")
REPORTS = 12


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Rejected payloads and losses in turn, after a keyframe."""
    made = write_log(tmp_path / "log", [envelope()])
    with LogWriter(made, fsync=NEVER) as writer:
        for number in range(REPORTS):
            key, content = (LOSS_KEY, LOSS) if number % 2 else (REJECTED_KEY, JUNK)
            writer.append(key, content, logged_ns=number)
    return made


@pytest.mark.parametrize("most", [0, 1, 5, REPORTS, 100])
def test_the_first_are_kept_and_all_are_counted(log: Path, most: int) -> None:
    at_once, in_steps = LogEvents(most), LogEvents(most)
    with LogReader(log) as reader:
        at_once.read_on(reader, Offset(REPORTS + 1))
        for end in range(1, REPORTS + 2):
            in_steps.read_on(reader, Offset(end))
    assert in_steps.events == at_once.events
    for found in (at_once, in_steps):
        assert [each["offset"] for each in found.events] == list(range(1, REPORTS + 1))[:most]
        assert (found.rejected, found.losses) == (REPORTS // 2, 3 * (REPORTS // 2))
        assert found.left_out == max(0, REPORTS - most)


def test_what_is_left_out_is_said(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def problems(most: int) -> list[str]:
        with LogMap(Opened(log, lambda _: Settings())) as shown:
            shown.log_events = LogEvents(most)
            shown.refresh()
            return shown.problems

    monkeypatch.setattr(log_map, "MOST_REPORTS", 5)
    assert problems(REPORTS) == []
    assert problems(5) == [
        "the timeline marks the first 5 rejected payloads and losses, not the 7 after them"
    ]


def test_segments_behind_the_limit_are_not_taken_for_missing_ones(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(6))
    with PrefixReader(log) as reader:
        for _ in range(2):  # the first is there when the limit is set, the second is not read
            write_log(log, walk(3, first=reader.refresh()))
            reader.refresh()
            reader.limit = Offset(4)
            reader.check_end()
            assert reader.next_offset == 4
