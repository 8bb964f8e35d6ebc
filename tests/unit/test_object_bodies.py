"""Heights and sizes of Objects: the medians of what their observations measured."""

import random
from typing import Any

import pytest

from eventsrc.envelope.ingest import Rejected, ingest
from eventsrc.envelope.model import Offset
from projections.adapters.ros.map_messages import MapMessages
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.deltas import Body
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.state_output import state_document
from projections.map.view import MapView
from projections.store.history import History
from projections.store.stored_view import StoredView
from projections.store.tables import Tables, TableWriter
from tests.support.envelopes import detection, envelope, payload
from tests.support.evidence_drives import drive
from tests.support.folds import Folded
from tests.support.ros_messages import TYPES


def seen(number: int, **fields: Any) -> dict[str, Any]:
    fields = {"position": [1.0, 2.0], **fields}
    return envelope(number, 0.1 * number, 0.0, detections=[detection("cup", [1.0, 0.0], **fields)])


def view_of(documents: list[dict[str, Any]], rules: Settings | None = None) -> MapView:
    return Folded.start(rules).extend(documents).view


def test_an_object_has_the_median_height_and_size_in_whatever_order_they_came() -> None:
    heights = [0.8, 0.9, 0.7, 5.0]
    documents = [seen(n, position_z=z, size=[z, 0.5, 0.25]) for n, z in enumerate(heights)]
    documents.append(seen(9))
    random.Random(3).shuffle(documents)
    view = view_of(documents)
    (found,) = view.objects.values()
    assert view.body_of(found) == Body(800_000, 800_000, 500_000, 250_000)
    (row,) = state_document(view, "")["objects"]
    assert (row["z"], row["size"]) == (0.8, [0.8, 0.5, 0.25])


def test_ros_is_shown_the_height_and_size_where_they_were_measured() -> None:
    messages = MapMessages(TYPES)
    for fields, middle, size in (
        ({"position_z": 0.9, "size": [0.8, 0.5, 0.25]}, 0.9, (0.8, 0.5, 0.25)),
        ({}, 0.1, (0.2, 0.2, 0.2)),
    ):
        view = view_of([seen(number, **fields) for number in range(2)])
        (thing,) = messages.objects(view, 0).detections
        markers = messages.markers(view)
        (cube,) = (each for (kind, _), each in markers.items() if kind == "objects")
        for pose, lengths in ((thing.bbox.center, thing.bbox.size), (cube.pose, cube.scale)):
            assert (pose.position.z, lengths.x, lengths.y, lengths.z) == (middle, *size)


def test_what_no_detection_measured_is_absent_and_leaves_the_digest_as_it_was() -> None:
    plain = view_of([seen(0)])
    (row,) = state_document(plain, "")["objects"]
    assert not {"z", "size"} & set(row)
    (row,) = state_document(view_of([seen(0, size=[1.0, 1.0, 1.0])]), "")["objects"]
    assert (row["size"], "z" in row) == ([1.0, 1.0, 1.0], False)
    loose = view_of([seen(0, position=None, position_z=1.0)])  # a height counts beside a position
    assert not loose.has_bodies
    digests = {map_digest(view) for view in (plain, view_of([seen(0, position_z=1.0)]))}
    assert len(digests) == 2


def test_after_a_relocation_the_height_is_that_of_the_new_position() -> None:
    rules = Settings(places="rooms", fusion="evidence")
    view = view_of(drive(5, 120), rules)
    moved = [found for found in view.objects.values() if found.relocations]
    assert moved
    for found in view.objects.values():
        since = found.relocations[-1].observation if found.relocations else 0
        bodies = [(o, view.observations[o].body) for o in found.observations]
        heights = sorted(b.z_um for o, b in bodies if b is not None and o >= since)
        body = view.body_of(found)
        expected = heights[(len(heights) - 1) // 2] if heights else None
        assert (None if body is None else body.z_um) == expected


def test_the_kept_history_gives_the_same_bodies_and_digest_at_every_offset() -> None:
    rules = Settings(places="rooms", fusion="evidence")
    folded = Folded.start(rules, NO_CORRECTIONS).extend(drive(5, 60))
    view, writer = MapView(rules, keep_embeddings=False), TableWriter(Tables())
    expected = []
    for offset, deltas in enumerate(folded.deltas):
        view.apply_event(Offset(offset), deltas)
        writer.add(Offset(offset), deltas)
        bodies = [view.body_of(found) for found in view.objects.values()]
        expected.append((view.has_bodies, bodies, map_digest(view)))
    assert any(body is not None for body in expected[-1][1])
    history = History(rules, NO_CORRECTIONS, Tables(writer.finish()), _no_map)
    for end, known in enumerate(expected, start=1):
        past = StoredView(history, Offset(end))
        bodies = [past.body_of(found) for found in past.objects.values()]
        assert (past.has_bodies, bodies, map_digest(past)) == known


def _no_map(offset: Offset) -> Any:
    raise AssertionError(offset)


FOREIGN: list[dict[str, Any]] = [
    {"size": [0.4, 0.3]},
    {"size": "large"},
    {"size": [1, 2, True]},
    {"position_z": "on the shelf"},
]


@pytest.mark.parametrize("fields", FOREIGN, ids=str)
def test_fields_of_another_shape_are_those_of_another_robot(fields: dict[str, Any]) -> None:
    plain = map_digest(view_of([seen(0)]))
    assert map_digest(view_of([seen(0, **fields)])) == plain
    assert map_digest(view_of([{**seen(0), "scan": [1.0, 2.0]}])) == plain
    read = ingest(payload(seen(0, **fields, more=float("nan"))))
    assert isinstance(read, Rejected)


@pytest.mark.parametrize("wrong", [{"size": [1, 2, 0]}, {"size": [1, 2, 1e9]}, {"position_z": 1e9}])
def test_wrong_heights_and_sizes_are_refused(wrong: dict[str, Any]) -> None:
    read = ingest(payload(seen(0, **wrong)))
    assert isinstance(read, Rejected)
    assert next(iter(wrong)) in read.reason
