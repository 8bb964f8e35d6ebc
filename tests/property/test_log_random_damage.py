"""A log of several segments, one of them growing, damaged in several places and ways at once.

Reading invents and repeats no event, starting a writer and recovering lose no readable event, and a
recovered log has no damage.
"""

import contextlib
import random
import shutil
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogWriter, recover_log, verify_log
from scripts.programs.attack.corruption import corrupt_log
from tests.support.fixtures_log import BY_HAND, KEY, envelope, read_log, read_with_gaps
from tests.support.thorough import stride

EVENTS = 25
PAYLOADS = [envelope(i, note="x" * random.Random(i).randrange(400)) for i in range(EVENTS)]
LATER = envelope(EVENTS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four sealed segments of six events and a growing one of one, as a killed writer leaves it."""
    log = tmp_path_factory.mktemp("whole") / "log"
    writer = LogWriter(log, fsync=BY_HAND, rotate_events=6)
    for number, payload in enumerate(PAYLOADS):
        writer.append(KEY, payload)
        if number % 3 == 2:
            writer.sync()
            writer.commit_if_due()
    writer.sync()
    writer._sealer.finish()
    writer._active.close()
    writer._lock.release()
    return log


def readable(log: Path) -> dict[int, bytes]:
    """Every event of a robot that is read, checked against what was written."""
    try:
        events, named = read_with_gaps(log)
    except LogError:
        return {}
    offsets = [event.offset for event in events]
    assert offsets == sorted(set(offsets))
    assert not named & set(offsets)
    found = {event.offset: event.payload for event in events if event.key == KEY}
    assert all(found[o] in (LATER, PAYLOADS[o] if o < EVENTS else LATER) for o in found)
    return found


@pytest.mark.parametrize("seed", range(0, 60, stride(4)))
def test_no_event_is_invented_and_no_readable_event_is_lost(
    whole: Path, quick_path: Path, seed: int
) -> None:
    log = quick_path / "log"
    shutil.copytree(whole, log)
    corrupt_log(log, random.Random(seed))
    before = readable(log).items()
    verify_log(log)
    with contextlib.suppress(LogError), LogWriter(log, fsync=ALWAYS) as writer:
        writer.append(KEY, LATER)
    assert before <= readable(log).items()
    recover_log(log)
    assert before <= readable(log).items()
    events = read_log(log)
    assert [event.offset for event in events] == list(range(len(events)))
    assert {event.key for event in events} <= {KEY, LOSS_KEY}
    assert {f.kind for f in verify_log(log).findings} <= {"loss", "time", "duplicate"}
    assert recover_log(log).segments == ()
