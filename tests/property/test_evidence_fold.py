"""Fusion by evidence in the whole fold: its deltas, its view, kept folds and histories."""

import copy
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from eventsrc.envelope.commands import Command, SameObject
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.object_explanation import explain_object
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.state_output import state_document
from projections.map.view import MapView
from tests.property.test_kept_folds import _plain
from tests.support.evidence_drives import (
    EVIDENCE,
    SLOW,
    check_recounts,
    compiled,
    det_ids,
    drive,
    drives,
    long_drive,
)
from tests.support.folds import Folded, resumed, state_bytes
from tests.support.histories import view_at
from tests.support.memory_history import MemoryHistory
from tests.support.thorough import mostly_slow
from tests.support.walks import write_log


def check_order(deltas: list[d.Delta]) -> None:
    """The order that `projections.fold.deltas` states."""
    kinds = (d.ObjectFound, d.ObjectsMerged, d.ObjectRelocated, d.ObjectClassified)
    ranks = {kind: rank for rank, kind in enumerate((*kinds, d.ObjectEstimated, d.ObjectMissing))}
    ranks[d.ObjectSeen] = ranks[d.ObjectFound]
    ranks[d.ObjectRelocated] = ranks[d.ObjectsMerged]
    found = [ranks[type(delta)] for delta in deltas if type(delta) in ranks]
    assert found == sorted(found)
    estimated = [delta.object for delta in deltas if isinstance(delta, d.ObjectEstimated)]
    assert estimated == sorted(set(estimated))
    absorbed = {delta.absorbed for delta in deltas if isinstance(delta, d.ObjectsMerged)}
    touched = {delta.object for delta in deltas if isinstance(delta, d.ObjectSeen)}
    assert touched - absorbed <= set(estimated)


@SLOW
@given(documents=drives())
def test_the_view_equals_a_recount_after_every_event(documents: list[dict[str, Any]]) -> None:
    folded = Folded.start(EVIDENCE)
    for document in documents:
        folded.extend([document])
        check_recounts(folded)
        check_order(folded.deltas[-1])
    event(f"merges: {bool(folded.all(d.ObjectsMerged))}")
    event(f"relocated: {bool(folded.all(d.ObjectRelocated))}")
    event(f"missing: {bool(folded.all(d.ObjectMissing))}")
    event(f"classified: {bool(folded.all(d.ObjectClassified))}")
    for merge in folded.all(d.ObjectsMerged):
        assert merge.evidence is not None
        assert merge.survivor < merge.absorbed


@SLOW
@given(documents=drives(), data=st.data())
def test_resume_then_fold_is_fold_from_the_start(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(documents)))
    named = det_ids(documents)
    commands: list[Command] = []
    if len(named) > 1 and data.draw(st.booleans()):
        pair = data.draw(st.permutations(named))[:2]
        commands = [SameObject(command_id="c", issued_by="me@here", det_ids=tuple(pair))]
    corrections = compiled(*commands)
    whole = Folded.start(EVIDENCE, corrections=corrections).extend(documents)
    begun = Folded.start(EVIDENCE, corrections=corrections).extend(documents[:cut])
    again = resumed(begun)
    again.extend(documents[cut:])
    assert [list(map(_plain, each)) for each in again.deltas] == [
        list(map(_plain, each)) for each in whole.deltas[cut:]
    ]
    assert map_digest(again.view) == map_digest(whole.view)
    assert state_bytes(again) == state_bytes(whole)


@SLOW
@given(documents=drives(), data=st.data())
def test_a_timeline_gives_the_fold_of_every_offset(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        with LogReader(log) as reader, LogTimeline(log, EVIDENCE) as timeline:
            assert timeline.end == len(documents)
            history = timeline.history
            for end in data.draw(st.lists(st.integers(0, len(documents)), max_size=4)):
                _, view = fold_log(reader, EVIDENCE, Offset(end))
                past = timeline.at(Offset(end))
                assert map_digest(past) == map_digest(view)
                assert state_document(past, "") == state_document(view, "")
                for found in view.objects.values():
                    told = timeline.why(found.object_id, Offset(end)).document()
                    assert told["class_name"] == found.class_name
                    assert told["class_counts"] == view.class_counts(found)
                    assert found.estimate is not None
                    assert told["estimate"]["x"] == found.estimate.est_x
                    assert told["missing"] is (found.missing_in is not None)
            assert len(history.object_merges) == len(timeline.knowing().object_merges())


@pytest.mark.parametrize("seed", mostly_slow([0, 5]))
def test_maps_of_things_carried_away_are_the_same_whichever_way_they_are_made(seed: int) -> None:
    """Recounted, out of kept folds, out of a history and as `why` tells them."""
    documents = long_drive(seed)
    whole = Folded.start(EVIDENCE).extend(documents)
    assert whole.all(d.ObjectMissing)
    assert whole.all(d.ObjectRelocated)
    check_recounts(whole)
    for deltas in whole.deltas:
        check_order(deltas)
    for cut in (90, 165, 239):
        begun = Folded.start(EVIDENCE).extend(documents[:cut])
        again = resumed(begun)
        again.extend(documents[cut:])
        assert [list(map(_plain, each)) for each in again.deltas] == [
            list(map(_plain, each)) for each in whole.deltas[cut:]
        ]
        assert state_bytes(again) == state_bytes(whole)
    history = MemoryHistory(EVIDENCE)
    for offset, deltas in enumerate(whole.deltas):
        history.apply(Offset(offset), deltas)
    for end in range(70, len(documents) + 1, 17):
        view = MapView(EVIDENCE)
        for offset, deltas in enumerate(whole.deltas[:end]):
            view.apply_event(Offset(offset), deltas)
        assert map_digest(view_at(history, whole.view, Offset(end))) == map_digest(view)
        for found in view.objects.values():
            told = explain_object(
                history,
                whole.view.observations.__getitem__,
                history.objects[found.ordinal],
                Offset(end),
            ).document()
            assert (told["missing"], told["misses"]) == (found.missing_in is not None, found.misses)
            moved = [each["offset"] for each in told["entries"] if each["what"] == "moved"]
            own = [delta.offset for delta in history.objects[found.ordinal].relocations]
            assert moved == [offset for offset in own if offset < end]


def test_the_drives_of_these_tests_meet_what_they_are_about() -> None:
    folded = Folded.start(EVIDENCE)
    for seed in range(6):
        documents = [{**e, "run_id": f"{e['run_id']}-{seed}"} for e in drive(seed, 60)]
        folded.extend(documents)
    assert folded.all(d.ObjectsMerged)
    assert folded.all(d.ObjectClassified)
    assert any(o.estimate and o.estimate.spots > 1 for o in folded.view.objects.values())


def test_depths_positions_and_cameras_change_the_map() -> None:
    documents = drive(3, 40)

    def digest(documents: list[dict[str, Any]], rules: Settings = EVIDENCE) -> str:
        return map_digest(Folded.start(rules).extend(documents).view)

    def changed(name: str, value: Any) -> list[dict[str, Any]]:
        less = copy.deepcopy(documents)
        for document in less:
            for seen in document["detections"]:
                if name in seen:
                    seen[name] = value
                else:
                    seen.pop(name, None)
        return less

    wide = EVIDENCE.with_assignments(["camera.hfov_deg=90"])
    stated = [
        {**e, "camera": {"hfov_deg": 90.0, "width_px": 640.0, "height_px": 400.0}}
        for e in documents
    ]
    digests = [
        digest(documents),
        digest(documents, wide),
        digest(changed("depth_m", 1.0)),
        digest(changed("depth_sigma_m", 1.0)),
        digest(changed("position", [1.0, 1.0])),
    ]
    assert len(set(digests)) == len(digests)
    assert digest(stated) == digest(stated, wide)
    page = Settings(eps_m=1.0)
    assert (
        digest(documents, page)
        == digest(stated, page)
        == digest(changed("position", [1.0, 1.0]), page)
    )


@pytest.mark.parametrize("yaw", [1e300, -1.7e308, 1e9, 5e-324])
def test_any_heading_that_an_envelope_may_have_is_folded(yaw: float) -> None:
    documents = [{**e, "map_yaw": yaw} for e in drive(1, 6) if e.get("map_x") is not None]
    folded = Folded.start(EVIDENCE).extend(documents)
    check_recounts(folded)
