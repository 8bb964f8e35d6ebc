"""Which Objects are confirmed, by both rules of fusion, against a recount from the envelopes: in
the view after every event, in the kept history at every offset, in the states of each Object."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import Settings
from projections.map.state_output import state_document
from projections.map.view import MapView
from projections.store.column_rows import TableWriter
from projections.store.history import History
from projections.store.object_states import ObjectStates
from projections.store.stored_view import StoredView
from projections.store.tables import Tables
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


def recounted(view: MapView, documents: list[dict[str, Any]]) -> dict[str, bool]:
    """By object_id whether it is confirmed: a slow recount from what was recorded."""
    posed = {(d["run_id"], d["keyframe_id"]): d for d in documents}
    found = {}
    for each in view.objects.values():
        sightings = []
        for number in each.observations:
            record = view.observations[number]
            keyframe = view.keyframes[record.keyframe]
            document = posed[keyframe.run_id, keyframe.keyframe_id]
            own = next(
                d
                for index, d in enumerate(document["detections"])
                if record.det_id
                == d.get("det_id", f"{keyframe.run_id}_kf{keyframe.keyframe_id}_d{index}")
            )
            is_measured = "depth_m" in own or "position" in own
            sightings.append((record.keyframe, document, is_measured))
        _, first, _ = min(sightings, key=lambda sighting: sighting[0])
        found[each.object_id] = any(
            is_measured
            or document["run_id"] != first["run_id"]
            or abs(document["timestamp"] - first["timestamp"]) > 60.0
            or (document["map_x"] - first["map_x"]) ** 2 + (document["map_y"] - first["map_y"]) ** 2
            >= 0.35**2 - 1e-12
            for _, document, is_measured in sightings
        )
    return found


@SLOW
@given(lingering_drives(), st.sampled_from(RULES))
def test_an_object_is_confirmed_by_another_spot_run_or_time_or_a_measured_distance(
    documents: list[dict[str, Any]], rules: Settings
) -> None:
    folded = Folded.start(rules).extend(documents)
    view, writer = MapView(rules, keep_embeddings=False), TableWriter(Tables())
    confirmed: list[dict[int, bool]] = [{}]
    for offset, deltas in enumerate(folded.deltas):
        view.apply_event(Offset(offset), deltas)
        writer.add(Offset(offset), deltas)
        expected = recounted(view, documents)
        assert {o.object_id: o.confirmed for o in view.objects.values()} == expected
        assert view.counts()["confirmed"] == sum(expected.values())
        confirmed.append({o: found.confirmed for o, found in view.objects.items()})
    tables = Tables(writer.finish())
    history = History(rules, NO_CORRECTIONS, tables, _no_map)
    for end, expected_at in enumerate(confirmed):
        past = StoredView(history, Offset(end))
        assert {o: found.confirmed for o, found in past.objects.items()} == expected_at
        rows = state_document(past, "")["objects"]
        assert [row["confirmed"] for row in rows] == list(expected_at.values())
    for number in view.objects:
        states = ObjectStates.of_one(tables, number)
        ends = zip(states.ends.tolist(), states.is_confirmed.tolist(), strict=True)
        assert all(confirmed[end][number] == is_confirmed for end, is_confirmed in ends)
