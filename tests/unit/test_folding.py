"""Folding events: what is skipped, what is refused; reading ahead changes nothing."""

import gc

import pytest

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import Event
from projections.fold.deltas import KeyframeAdded
from projections.fold.map_errors import FoldError
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import fold_event, fold_events
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope, payload


def _event(offset: int, content: bytes, key: str = "tb/detections") -> Event:
    return Event(offset, key, 0, 0, content)


def _events(count: int) -> list[Event]:
    """Envelopes with none, one or two detections, of two dimensions, and an event of our own."""
    events = []
    for i in range(count):
        seen = [
            detection("cup", [1.0, i, 2.0][: 2 + i % 2], det_id=f"{i}-{d}") for d in range(i % 3)
        ]
        events.append(_event(i, payload(envelope(i, i / 2, 0.0, detections=seen))))
    return [*events, _event(count, b"{}", LOSS_KEY), _event(count + 1, payload(envelope(99)))]


@pytest.mark.parametrize("ahead", [2, 3, 16, 100])
def test_reading_ahead_changes_nothing(ahead: int) -> None:
    one_by_one = list(fold_events(_events(20), SemanticMap(Settings())))
    together = list(fold_events(_events(20), SemanticMap(Settings()), ahead=ahead))
    assert [f.offset for f in together] == list(range(22))
    assert list(map(repr, together)) == list(map(repr, one_by_one))
    assert together[20].deltas == []


@pytest.mark.parametrize("ahead", [1, 16])
def test_an_envelope_that_does_not_validate_stops_the_fold_at_its_offset(ahead: int) -> None:
    events = _events(6)
    events[3] = _event(3, b'{"run_id": 7}')
    semantic_map, folded = SemanticMap(Settings()), []
    with pytest.raises(FoldError, match=r"offset 3.*run_id") as caught:
        folded.extend(fold_events(events, semantic_map, ahead=ahead))
    assert caught.value.offset == 3
    assert semantic_map.next_offset == 3
    semantic_map.skip(3)
    rest = list(fold_events(events[4:], semantic_map, ahead=ahead))
    assert [f.offset for f in rest] == [4, 5, 6, 7]
    assert semantic_map.folded_ids.offsets.tolist() == [0, 1, 2, 4, 5, 7]


@pytest.mark.parametrize("whole", [True, False])
def test_what_was_made_of_a_map_is_made_again_once_the_map_has_changed(whole: bool) -> None:
    def keyframes(of: MapView) -> list[int]:
        return [each.keyframe_id for each in of.keyframes]

    view = MapView(Settings())
    for folded in fold_events(_events(3)[:3], SemanticMap(Settings())):
        if whole:
            view.apply_event(folded.offset, folded.deltas)
        else:
            for delta in folded.deltas:
                view.apply(delta)
        assert view.once(keyframes) == keyframes(view)
        assert view.once(keyframes) is view.once(keyframes)


def test_one_event_is_not_read_before_it_is_asked_for() -> None:
    asked = []

    def coming():
        for event in _events(3):
            asked.append(event.offset)
            yield event

    folded = fold_events(coming(), SemanticMap(Settings()))
    next(folded)
    assert asked == [0]


def test_fold_event_gives_the_deltas_of_one() -> None:
    deltas = fold_event(_events(1)[0], SemanticMap(Settings()))
    assert [type(d) for d in deltas[1:]] == [KeyframeAdded]


@pytest.mark.parametrize("was_on", [True, False])
def test_the_garbage_collector_is_left_on_or_off_as_it_was(was_on: bool) -> None:
    before = gc.isenabled()
    try:
        (gc.enable if was_on else gc.disable)()
        with gc_paused():
            assert not gc.isenabled()
        assert gc.isenabled() == was_on
    finally:
        (gc.enable if before else gc.disable)()
