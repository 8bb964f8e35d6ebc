"""kill -9 at random moments: no acknowledged event is lost or recorded twice.

`scripts/chaos_log` does the same for as long as one likes. `mapfold record` is killed in
`tests/chaos/test_recorder_kills.py`.
"""

import random
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import Event, LogReader, LogWriter, NewEvent, follow, recover_log, verify_log
from eventsrc.log.format import list_segments
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_event, fold_log
from projections.map.view import MapView
from scripts.programs.chaos.log_killer import LONGEST_LIFE_S, lives
from tests.support.fixtures_log import flip
from tests.support.logs import mixed_events
from tests.support.thorough import THOROUGH

SEED = 20260415


@pytest.mark.slow
@pytest.mark.parametrize(("fsync", "times"), [("5ms", 3), ("always", 3)])
def test_a_few_kills(log_path: Path, fsync: str, times: int) -> None:
    _kill(log_path, fsync, times)


@pytest.mark.slow
@pytest.mark.parametrize("fsync", ["always", "5ms", "50ms"])
def test_thirty_kills(log_path: Path, fsync: str) -> None:
    _kill(log_path, fsync, 30)


@pytest.mark.seconds
def test_messages_pictures_and_envelopes_survive_kills(log_path: Path, tmp_path: Path) -> None:
    _check_mixed(log_path, tmp_path / "alone", times=2)


@pytest.mark.slow
def test_messages_pictures_and_envelopes_survive_thirty_kills(
    log_path: Path, tmp_path: Path
) -> None:
    _check_mixed(log_path, tmp_path / "alone", times=30)


def _check_mixed(log: Path, alone: Path, times: int) -> None:
    """Killed mid-write again and again, recovered, verified, replayed and tailed, the log gives the
    map of its envelopes alone; also after a chunk of it has rotted."""
    _kill(log, "5ms", times, mixed=True)
    assert verify_log(log).findings == ()
    with LogReader(log) as reader:
        events = list(reader.read())
    assert events == mixed_events(len(events))
    assert recover_log(log).findings is False
    assert _digests(log) == _digests_of_envelopes(events, alone)
    segment = list_segments(log)[0]
    with LogReader(log) as reader:
        chunk = reader.open_segment(segment).chunks[0]
    flip(segment.path, chunk.position + chunk.length // 2)
    assert recover_log(log).findings
    with LogReader(log) as reader:
        kept = list(reader.read())
    lost = range(chunk.first, chunk.following)
    assert {event.offset for event in kept if event.key == LOSS_KEY} == set(lost)
    assert [e for e in kept if e.key != LOSS_KEY] == [e for e in events if e.offset not in lost]
    assert _digests(log) == _digests_of_envelopes(kept, alone)


def _digests_of_envelopes(events: Sequence[Event], log: Path) -> set[str]:
    shutil.rmtree(log, ignore_errors=True)
    with LogWriter(log) as writer:
        for event in events:
            if event.is_envelope:
                times = event.logged_ns, event.stamp_ns
                writer.append_all([NewEvent(event.key, event.payload, *times)])
    return _digests(log)


def _digests(log: Path) -> set[str]:
    """Of a replay, and of a tail."""
    with LogReader(log) as reader:
        replayed = map_digest(fold_log(reader, Settings())[1])
        end = reader.next_offset
    semantic_map, view = SemanticMap(Settings()), MapView(Settings())
    stop = threading.Event()
    for event in follow(log, FIRST_OFFSET, stop=stop):
        if event is None and view.next_offset == end:
            stop.set()
        elif event is not None:
            view.apply_event(event.offset, fold_event(event, semantic_map))
    assert map_digest(view) == replayed
    return {replayed}


def _kill(log: Path, fsync: str, times: int, *, mixed: bool = False) -> None:
    longest_s = LONGEST_LIFE_S if THOROUGH else LONGEST_LIFE_S / 6  # all of it is read again
    rng = random.Random(SEED)
    lived = list(lives(log, times, fsync, rng, mixed=mixed, longest_s=longest_s))
    assert lived
    assert sum(life.acknowledged for life in lived) > 0
    assert [life.lost for life in lived] == [0] * len(lived)
    damage = {f.kind for f in verify_log(log).findings} - {"schema", "time"}
    assert damage == set()
