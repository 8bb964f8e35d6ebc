"""Fusion by evidence in the whole fold under corrections: objects, events and poses."""

import copy
import math
from typing import Any

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from eventsrc.envelope.commands import (
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    ForgetKeyframes,
    RigidTransform,
    SameObject,
)
from projections.fold import deltas as d
from projections.fold.exact import metres_to_um
from projections.map.state_output import state_document
from projections.map.view import MapView
from tests.support.evidence_drives import EVIDENCE, SLOW, check_recounts, compiled, det_ids, drives
from tests.support.folds import Folded


@SLOW
@given(documents=drives(), data=st.data())
def test_same_and_different_objects_are_obeyed(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    named = det_ids(documents)
    if len(named) < 4:
        return
    few = data.draw(st.permutations(named))[:5]
    pairs = st.tuples(st.sampled_from(few), st.sampled_from(few)).filter(lambda p: p[0] != p[1])
    kinds = st.sampled_from([SameObject, DifferentObjects])
    stated = data.draw(st.lists(st.tuples(kinds, pairs), min_size=1, max_size=4))
    corrections = compiled(
        *(
            kind(command_id=f"c{n}", issued_by="me@here", det_ids=pair)
            for n, (kind, pair) in enumerate(stated)
        )
    )
    folded = Folded.start(EVIDENCE, corrections=corrections).extend(documents)
    objects = {o.det_id: o.object for o in folded.view.observations}
    for a, b in corrections.same:
        assert objects[a] == objects[b]
    for a, b in corrections.different:
        assert objects[a] != objects[b]
    check_recounts(folded, same=True)
    by_command = [m for m in folded.all(d.ObjectsMerged) if m.evidence is None]
    event(f"merged by command: {bool(by_command)}")


@SLOW
@given(documents=drives(), data=st.data())
def test_forgotten_and_dropped_events_fold_as_if_absent(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    """But for ordinals of keyframes, the map is that of the events without it."""
    named = det_ids(documents) or ["none"]
    first = data.draw(st.integers(0, 30))
    dropped = data.draw(st.lists(st.sampled_from(named), min_size=1, max_size=3, unique=True))
    head = {"issued_by": "me@here", "run_id": "run-a"}
    corrections = compiled(
        ForgetKeyframes(command_id="a", **head, first=first, last=first + 4),
        DropDetection(command_id="b", issued_by="me@here", det_ids=tuple(dropped)),
    )
    less = []
    for document in documents:
        if document["run_id"] == "run-a" and first <= document["keyframe_id"] <= first + 4:
            continue
        ids = [
            f"{document['run_id']}_kf{document['keyframe_id']}_d{i}"
            for i in range(len(document["detections"]))
        ]
        kept = [
            {**seen, "det_id": det_id}
            for det_id, seen in zip(ids, document["detections"], strict=True)
            if det_id not in dropped
        ]
        less.append({**document, "detections": kept})
    corrected = Folded.start(EVIDENCE, corrections=corrections).extend(documents).view
    plain = Folded.start(EVIDENCE).extend(less).view
    assert _things(corrected) == _things(plain)


def _things(view: MapView) -> list[dict[str, Any]]:
    """The objects, without the offsets of their relocations."""
    rows: list[dict[str, Any]] = state_document(view, "")["objects"]
    return [
        {**row, "relocations": [[r["from"], r["to"]] for r in row["relocations"]]} for row in rows
    ]


@SLOW
@given(
    documents=drives(), turn=st.sampled_from([(0.5, -1.0, 0.0), (0.0, 0.0, 0.3), (2.0, 1.0, 3.0)])
)
def test_corrected_poses_give_the_map_of_those_poses_and_carry_positions_along(
    documents: list[dict[str, Any]], turn: tuple[float, float, float]
) -> None:
    transform = RigidTransform.of(*turn)
    command = CorrectPoses(command_id="a", issued_by="me@here", run_id="run-b", transform=transform)
    corrections = compiled(command)
    folded = Folded.start(EVIDENCE, corrections=corrections).extend(documents)
    poses = {(k.run_id, k.keyframe_id): k.pose for k in folded.view.keyframes}
    written = [copy.deepcopy(e) for e in documents]  # some are one object
    cos, sin = math.cos(turn[2]), math.sin(turn[2])
    for document in written:
        pose = poses[document["run_id"], document["keyframe_id"]]
        if document["run_id"] != "run-b" or pose is None:
            continue
        x, y = document["map_x"], document["map_y"]
        new_x, new_y = cos * x - sin * y + turn[0], sin * x + cos * y + turn[1]
        assert abs(metres_to_um(new_x) - pose.x_um) <= 1
        document |= {"map_x": pose.x_m, "map_y": pose.y_m, "map_yaw": pose.yaw_rad}
        for seen in document["detections"]:
            if "position" in seen:
                dx, dy = seen["position"][0] - x, seen["position"][1] - y
                seen["position"] = [new_x + cos * dx - sin * dy, new_y + sin * dx + cos * dy]
    plain = Folded.start(EVIDENCE).extend(written).view
    mine = {found.object_id: found for found in folded.view.objects.values()}
    assert [*mine] == [found.object_id for found in plain.objects.values()]
    for found in plain.objects.values():
        assert found.observations == mine[found.object_id].observations
        for at in (found.estimate, mine[found.object_id].estimate):
            assert at is not None
        assert found.estimate is not None
        assert mine[found.object_id].estimate is not None
        assert found.estimate.est_x == pytest.approx(mine[found.object_id].estimate.est_x, abs=1e-4)
        assert found.estimate.est_y == pytest.approx(mine[found.object_id].estimate.est_y, abs=1e-4)
