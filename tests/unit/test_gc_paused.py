"""`gc_paused`: no search for cycles during a bulk fold, nor among its objects right after."""

import gc
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.commands import CorrectedPose, CorrectPoses, encode_command
from eventsrc.envelope.model import KeyframeId, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import NEVER, LogReader, LogWriter
from projections.map.parsing import read_corrections


def _is_young(thing: object) -> bool:
    return any(thing is other for n in (0, 1) for other in gc.get_objects(generation=n))


def test_the_collector_is_off_inside_and_skips_what_was_made_afterwards() -> None:
    before = [[]]  # type: ignore[var-annotated]
    assert _is_young(before)
    with gc_paused():
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]  # type: ignore[var-annotated]
        assert _is_young(made)
    assert gc.isenabled()
    assert not _is_young(made)
    assert gc.get_freeze_count() == 0  # old, yet still searched when its time comes


def test_the_collector_is_as_before_after_an_error_too() -> None:
    with pytest.raises(ZeroDivisionError), gc_paused():
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with gc_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_nothing_is_searched_while_thousands_of_commands_are_read(tmp_path: Path) -> None:
    log = tmp_path / "log"
    pose = (CorrectedPose(keyframe_id=KeyframeId(1), x=0.0, y=0.0, yaw=0.0),)
    with LogWriter(log, fsync=NEVER) as writer:
        for number in range(2_000):
            own = {"command_id": f"c{number}", "issued_by": "ann"}
            given = CorrectPoses(**own, run_id=RunId("a"), poses=pose)
            writer.append(COMMAND_KEY, encode_command(given))
    searches = []

    def note(phase: str, info: dict[str, Any]) -> None:
        if phase == "stop" and info["generation"]:
            searches.append(info)

    with LogReader(log) as reader:
        thresholds = gc.get_threshold()
        gc.collect()
        gc.set_threshold(700, 10, 10)  # Python's own; those of the tests are higher
        gc.callbacks.append(note)
        try:
            corrections = read_corrections(reader)
            corrections.fingerprint()
        finally:
            gc.callbacks.remove(note)
            gc.set_threshold(*thresholds)
    assert len(corrections.in_force) == 2_000
    assert not searches
