"""Which Objects are confirmed, by both rules of fusion, against a recount from the envelopes: in
the view after every event, in the kept history at every offset, in the states of each Object."""

from itertools import chain
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import DetId, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta, ObjectSeen, ObjectsMerged
from projections.fold.settings import Settings
from projections.map.state_output import state_document
from projections.map.view import MapView
from projections.store.history import History
from projections.store.object_states import ObjectStates
from projections.store.stored_view import StoredView
from projections.store.tables import Tables, TableWriter
from tests.support.envelopes import detection, envelope
from tests.support.evidence_drives import EVIDENCE, SLOW
from tests.support.folds import Folded

RULES = (Settings(fusion_radius_m=2.0), EVIDENCE)
SPOTS = ((0.0, 0.0), (0.2, 0.0), (0.35, 0.0), (0.0, 0.349), (2.0, 1.0))
LOOKS = ([1.0, 0.1, 0.0], [0.0, 1.0, 0.1])


@st.composite
def lingering_drives(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Keyframes of two runs from a few spots, at times around the bounds of the rule."""
    documents = []
    for number in range(draw(st.integers(0, 14))):
        x, y = draw(
            st.sampled_from([(0.0, 0.0), (0.2, 0.0), (0.35, 0.0), (0.0, 0.349), (2.0, 1.0)])
        )
        seen = []
        for thing in draw(st.sets(st.integers(0, 1))):
            more: dict[str, Any] = {"depth_m": 1.5} if draw(st.integers(0, 9)) == 0 else {}
            if draw(st.integers(0, 9)) == 0:
                more["position"] = [1.0, 0.5]
            box = [300.0, 100.0, 340.0, 300.0]
            seen.append(detection("cup", LOOKS[thing], bbox=box, **more))
        documents.append(
            envelope(
                number,
                None if draw(st.integers(0, 9)) == 0 else x,
                y,
                run_id=draw(st.sampled_from(["run-a", "run-a", "run-b"])),
                timestamp=draw(st.sampled_from([0.0, 30.0, 60.0, 60.5, 300.0])),
                detections=seen,
            )
        )
    return documents


def _no_map(offset: Offset) -> OccupancyMap:
    raise AssertionError(offset)


class Recount:
    """Which Objects are confirmed after some deltas: a slow recount from what was recorded."""

    def __init__(self, view: MapView, documents: list[dict[str, Any]]) -> None:
        self.view = view
        self.documents = {(d["run_id"], d["keyframe_id"]): d for d in documents}
        self.sightings: dict[int, list[int]] = {}
        self.confirmed: set[int] = set()

    def take(self, delta: Delta) -> None:
        match delta:
            case ObjectSeen(object=one, observation=seen):
                if seen not in chain.from_iterable(self.sightings.values()):
                    self._add(one, [seen])
            case ObjectsMerged(survivor=one, absorbed=absorbed):
                if absorbed in self.confirmed:
                    self.confirmed.add(one)
                self._add(one, self.sightings.pop(absorbed))

    def _add(self, one: int, seen: list[int]) -> None:
        self.sightings.setdefault(one, []).extend(seen)
        every = [self._sighting(number) for number in self.sightings[one]]
        _, first, _ = min(every, key=lambda sighting: sighting[0])
        if any(
            is_measured
            or document["run_id"] != first["run_id"]
            or abs(document["timestamp"] - first["timestamp"]) > 60.0
            or (document["map_x"] - first["map_x"]) ** 2 + (document["map_y"] - first["map_y"]) ** 2
            >= 0.35**2 - 1e-12
            for _, document, is_measured in every
        ):
            self.confirmed.add(one)

    def _sighting(self, number: int) -> tuple[int, dict[str, Any], bool]:
        """Keyframe, envelope, and whether distance or position were measured."""
        record = self.view.observations[number]
        keyframe = self.view.keyframes[record.keyframe]
        document = self.documents[keyframe.run_id, keyframe.keyframe_id]
        own = next(
            d
            for index, d in enumerate(document["detections"])
            if record.det_id
            == d.get("det_id", f"{keyframe.run_id}_kf{keyframe.keyframe_id}_d{index}")
        )
        return record.keyframe, document, "depth_m" in own or "position" in own


@SLOW
@given(lingering_drives(), st.sampled_from(RULES))
def test_an_object_is_confirmed_by_another_spot_run_or_time_or_a_measured_distance(
    documents: list[dict[str, Any]], rules: Settings
) -> None:
    check_confirmed(documents, rules, NO_CORRECTIONS)


def test_an_object_that_absorbs_a_confirmed_one_is_confirmed() -> None:
    """The one is seen from two spots, each near that from which the other was founded."""
    spots, looks = (0.0, -0.2, 0.2, 0.0), (LOOKS[0], LOOKS[1], LOOKS[1], LOOKS[1])
    documents = [
        envelope(
            number, x, 0.0, timestamp=0.0, detections=[detection("cup", look, det_id=f"d{number}")]
        )
        for number, (x, look) in enumerate(zip(spots, looks, strict=True))
    ]
    assert check_confirmed(documents, RULES[0], NO_CORRECTIONS) == [False, True]
    same = Corrections(same=((DetId("d0"), DetId("d3")),))
    assert check_confirmed(documents, RULES[0], same) == [True]


def check_confirmed(
    documents: list[dict[str, Any]], rules: Settings, corrections: Corrections
) -> list[bool]:
    """Compare the view, the kept history and the states of each Object with the recount, after
    every event. Returns what is confirmed in the end."""
    folded = Folded.start(rules, corrections).extend(documents)
    view, writer = MapView(rules, keep_embeddings=False), TableWriter(Tables())
    confirmed: list[dict[int, bool]] = [{}]
    recount = Recount(view, documents)
    for offset, deltas in enumerate(folded.deltas):
        view.apply_event(Offset(offset), deltas)
        writer.add(Offset(offset), deltas)
        for delta in deltas:
            recount.take(delta)
        expected = recount.confirmed & set(view.objects)
        assert {o for o, found in view.objects.items() if found.confirmed} == expected
        assert view.counts()["confirmed"] == len(expected)
        confirmed.append({o: found.confirmed for o, found in view.objects.items()})
    tables = Tables(writer.finish())
    history = History(rules, corrections, tables, _no_map)
    for end, expected_at in enumerate(confirmed):
        past = StoredView(history, Offset(end))
        assert {o: found.confirmed for o, found in past.objects.items()} == expected_at
        rows = state_document(past, "")["objects"]
        assert [row["confirmed"] for row in rows] == list(expected_at.values())
    for number in view.objects:
        states = ObjectStates.of_one(tables, number)
        ends = zip(states.ends.tolist(), states.is_confirmed.tolist(), strict=True)
        assert all(confirmed[end][number] == is_confirmed for end, is_confirmed in ends)
    return list(confirmed[-1].values())
