"""Fusion by evidence in the whole fold: its deltas, its view, snapshots, histories, corrections."""

import copy
import math
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from eventsrc.commands import (
    Command,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    ForgetKeyframes,
    RigidTransform,
    SameObject,
)
from eventsrc.envelope import Offset
from eventsrc.log import LogReader
from projections import deltas as d
from projections.corrections import Corrections, RecordedCommand, compile_corrections
from projections.exact import metres_to_um
from projections.history import Timeline
from projections.history.explanation import explain_object
from projections.history.history import History
from projections.history.past_view import view_at
from projections.model.digest import map_digest
from projections.model.export import state_document
from projections.model.fold import fold_log
from projections.model.snapshot import restore, snapshot
from projections.model.view import MapView
from projections.settings import Settings
from tests.fixtures_timetravel import write_log
from tests.folds import (
    Folded,
    recounted_adjacency,
    recounted_places,
)
from tests.property.test_snapshots import _plain
from tests.rooms_with_things import drive, drives, long_drive
from tests.thorough import examples, mostly_slow

EVIDENCE = Settings(fusion="evidence", eps_m=1.0)
SLOW = settings(
    deadline=None,
    max_examples=examples(40),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


TURNS = [(0.5, -1.0, 0.0), (0.0, 0.0, 0.3), (2.0, 1.0, 3.0)]


def compiled(*commands: Command) -> Corrections:
    return compile_corrections(RecordedCommand(Offset(n), c) for n, c in enumerate(commands))


def det_ids(documents: list[dict[str, Any]]) -> list[str]:
    """Those that can be of an Object, each once."""
    named = (
        f"{e['run_id']}_kf{e['keyframe_id']}_d{i}"
        for e in documents
        for i, seen in enumerate(e["detections"])
        if e.get("map_x") is not None and seen.get("embedding") is not None
    )
    return list(dict.fromkeys(named))


def recounted_votes(view: MapView, deltas: list[d.Delta]) -> list[int | None]:
    """The place of each Object, from the keyframes that saw it since it stands where it does."""
    votes: dict[int, list[int]] = {}
    for delta, following in zip(deltas, [*deltas[1:], None], strict=True):
        if isinstance(delta, d.ObjectSeen):
            keyframe = view.observations[delta.observation].keyframe
            votes.setdefault(delta.object, []).append(keyframe)
        elif isinstance(delta, d.ObjectsMerged):
            if isinstance(following, d.ObjectRelocated):
                votes[delta.survivor] = []
            votes[delta.survivor] += votes.pop(delta.absorbed)
    located: list[int | None] = []
    for ordinal in view.objects:
        cast = Counter(view.keyframes[keyframe].place for keyframe in votes[ordinal])
        del cast[None]
        located.append(min(cast, key=lambda p: (-cast[p], p or 0), default=None))
    return located


def check_recounts(folded: Folded, same: bool = False) -> None:
    """All that can be counted again from the observations of each Object."""
    view, deltas = folded.view, [delta for each in folded.deltas for delta in each]
    seen_beside = {  # what a few pictures showed as two may still be one
        view.object_survivors.find(delta.survivor)
        for delta in deltas
        if isinstance(delta, d.ObjectsMerged)
        and delta.evidence
        and delta.evidence.pictures_with_both
    }
    assert view.adjacency == recounted_adjacency(view)
    assert [found.place for found in view.objects.values()] == recounted_votes(view, deltas)
    assert {
        p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()
    } == recounted_places(view)
    for found in view.objects.values():
        seen = [view.observations[number] for number in found.observations]
        keyframes = [view.keyframes[each.keyframe] for each in seen]
        assert found.observations == sorted(found.observations)
        assert all(each.object == found.ordinal for each in seen)
        assert found.obs_count == len(seen)
        poses = [k.pose for k in keyframes if k.pose is not None]
        assert found.sum_x_um == sum(pose.x_um for pose in poses)
        assert found.sum_y_um == sum(pose.y_um for pose in poses)
        times = [k.timestamp for k in keyframes]
        assert (found.first_seen, found.last_seen) == (min(times), max(times))
        votes = Counter(each.class_name for each in seen)
        assert votes[found.class_name] == max(votes.values())
        assert votes == view.class_counts(found)
        if not same and found.ordinal not in seen_beside:
            assert len({each.keyframe for each in seen}) == len(seen), "two of one picture"
        at = found.estimate
        assert at is not None
        assert at.spots >= 1
        assert at.var_xx_um2 > 0
        assert at.var_yy_um2 > 0
        assert at.var_xx_um2 * at.var_yy_um2 >= at.var_xy_um2**2


def check_order(deltas: list[d.Delta]) -> None:
    """The order that `projections.deltas` states."""
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
def test_restore_then_fold_is_fold_from_the_start(
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
    data_ = snapshot(begun.map, begun.view, "log")
    again = Folded(*restore(data_, EVIDENCE, "log", corrections=corrections), [])
    again.extend(documents[cut:])
    assert [list(map(_plain, each)) for each in again.deltas] == [
        list(map(_plain, each)) for each in whole.deltas[cut:]
    ]
    assert map_digest(again.view) == map_digest(whole.view)
    assert snapshot(again.map, again.view, "log") == snapshot(whole.map, whole.view, "log")


@SLOW
@given(documents=drives(), data=st.data())
def test_a_timeline_gives_the_fold_of_every_offset(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        with LogReader(log) as reader, Timeline(log, EVIDENCE) as timeline:
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


@pytest.mark.parametrize("seed", mostly_slow([0, 5]))
def test_maps_of_things_carried_away_are_the_same_whichever_way_they_are_made(seed: int) -> None:
    """Recounted, out of snapshots, out of a history and as `why` tells them."""
    documents = long_drive(seed)
    whole = Folded.start(EVIDENCE).extend(documents)
    assert whole.all(d.ObjectMissing)
    assert whole.all(d.ObjectRelocated)
    check_recounts(whole)
    for deltas in whole.deltas:
        check_order(deltas)
    for cut in (90, 165, 239):
        begun = Folded.start(EVIDENCE).extend(documents[:cut])
        again = Folded(*restore(snapshot(begun.map, begun.view, "log"), EVIDENCE, "log"), [])
        again.extend(documents[cut:])
        assert [list(map(_plain, each)) for each in again.deltas] == [
            list(map(_plain, each)) for each in whole.deltas[cut:]
        ]
        assert snapshot(again.map, again.view, "log") == snapshot(whole.map, whole.view, "log")
    history = History(EVIDENCE)
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
