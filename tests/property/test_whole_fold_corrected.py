"""The fold under any corrections equals the naive map of the corrected events."""

import random
from typing import Any

from hypothesis import event, given
from hypothesis import strategies as st

from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectedPose,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    ForgetKeyframes,
    ForgetRun,
    Join,
    KeepApart,
    NamePlace,
    Relabel,
    RigidTransform,
    SameObject,
    Undo,
    UndoMerge,
)
from eventsrc.envelope.model import Offset
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.deltas import MergeRefused, ObjectsMerged, PlacesMerged
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from tests.property.test_whole_fold import LOOKS, worlds
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, resumed
from tests.support.naive_map import NaiveCorrectedMap, corrected

World = tuple[dict[str, Any], list[dict[str, Any]], list[Command]]


def command(rng: random.Random, number: int, documents: list[dict[str, Any]]) -> Command:
    """Any command but `UseSettings`, mostly about what is in the documents."""
    head = {"command_id": f"c{number}", "issued_by": "ann@lab"}

    def keyframe() -> tuple[str, int]:
        chosen = rng.choice(documents)
        return chosen["run_id"], chosen["keyframe_id"]

    def anchors(count: int) -> tuple[Anchor, ...]:
        chosen = [keyframe() for _ in range(count)]
        return tuple(Anchor(run_id=run, keyframe_id=k) for run, k in chosen)

    det_ids = [
        d.get("det_id", f"{e['run_id']}_kf{e['keyframe_id']}_d{i}")
        for e in documents
        for i, d in enumerate(e["detections"])
    ] or ["none"]
    run, k = keyframe()
    if (kind := rng.randrange(15)) == 0:
        return ForgetRun(**head, run_id=run)
    if kind == 1:
        return ForgetKeyframes(**head, run_id=run, first=k, last=k + rng.randrange(5))
    if kind == 2:
        poses = (CorrectedPose(keyframe_id=k, x=rng.randrange(9) * 0.5, y=0.25, yaw=0.5),)
        return CorrectPoses(**head, run_id=run, poses=poses)
    if kind == 3:
        turn = RigidTransform.of(rng.choice([0.25, -1.0]), 0.5, rng.choice([0.0, 0.1]))
        first, last = rng.choice([(None, None), (k, None), (None, k), (k, k + 3)])
        return CorrectPoses(**head, run_id=run, transform=turn, first=first, last=last)
    if kind == 4:
        return DropDetection(**head, det_ids=tuple(rng.sample(det_ids, 1)))
    if kind == 5:
        return NamePlace(**head, place=anchors(1)[0], name=rng.choice(["hall", "bath"]))
    if kind == 6:
        return UndoMerge(**head, merge_offset=Offset(3), places=anchors(3))
    if kind == 7:
        return Undo(**head, undone=f"c{rng.randrange(number + 1)}")
    if kind < 10:
        return KeepApart(**head, places=anchors(2))
    if kind == 10:
        return Join(**head, places=anchors(2))
    if kind == 14:
        classes = sorted({d["class"] for e in documents for d in e["detections"]}) or ["cup"]
        label, name = rng.choice(classes), rng.choice([*classes, "other"])
        return Relabel(**head, labels=((label, name), ("17", "other")))
    pair = rng.choice(det_ids), rng.choice(det_ids)
    return (SameObject if kind < 13 else DifferentObjects)(**head, det_ids=pair)


@st.composite
def corrected_worlds(draw: st.DrawFn) -> World:
    """A world of `test_whole_fold` and commands about it."""
    settings, documents = draw(worlds())
    rng = random.Random(draw(st.integers(0, 2**32)))
    count = rng.randrange(1, 9) if documents else 0
    return settings, documents, [command(rng, n, documents) for n in range(count)]


@st.composite
def worlds_of_objects(draw: st.DrawFn) -> World:
    """Many Objects of few looks, side by side, that commands make one and keep apart."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    settings = {
        "eps_m": 0.75,
        "min_samples": rng.choice([1, 2, 3]),
        "fusion_radius_m": rng.choice([0.5, 1.0, 3.0]),
        "fusion_similarity": rng.choice([0.0, 0.7, 0.98]),
    }
    documents = []
    for number in range(rng.randrange(5, 25)):
        seen = [
            detection(rng.choice(["cup", "chair"]), rng.choice(LOOKS[:5]))
            for _ in range(rng.randrange(4))
        ]
        x, y = rng.randrange(8) * 0.5, rng.randrange(3) * 0.5
        documents.append(envelope(number, x, y, run_id=rng.choice("ab"), detections=seen))
    det_ids = [
        f"{e['run_id']}_kf{e['keyframe_id']}_d{i}"
        for e in documents
        for i in range(len(e["detections"]))
    ]
    few = rng.sample(det_ids, min(len(det_ids), rng.choice([3, 6])))
    commands: list[Command] = []
    for number in range(rng.randrange(1, 8) if len(few) > 1 else 0):
        head = {"command_id": f"c{number}", "issued_by": "ann@lab"}
        a, b = rng.sample(few, 2)
        kind = rng.choice([SameObject, SameObject, DifferentObjects])
        commands.append(kind(**head, det_ids=(a, b)))
    return settings, documents, commands


def compiled(commands: list[Command]) -> Corrections:
    return compile_corrections(RecordedCommand(Offset(n), c) for n, c in enumerate(commands))


@given(world=st.one_of(corrected_worlds(), worlds_of_objects()))
def test_after_every_event_the_digest_is_that_of_the_naive_corrected_map(world: World) -> None:
    raw, documents, commands = world
    corrections, settings = compiled(commands), Settings(**raw)
    folded = Folded.start(settings, corrections=corrections)
    naive = NaiveCorrectedMap(raw, corrections)
    for number, document in enumerate(documents):
        folded.extend([document])
        naive.fold(document)
        assert map_digest(folded.view) == naive.digest()
        if number % 3 == 0:
            again = resumed(folded)
            folded = Folded(again.map, again.view, folded.deltas)
    counts = {kind: naive.left_out[kind] for kind in folded.view.skipped}
    assert folded.view.skipped == counts
    for kind in (MergeRefused, ObjectsMerged):
        event(f"{kind.__name__}: {bool(folded.all(kind))}")
    event(f"joined: {any(merge.joined for merge in folded.all(PlacesMerged))}")


@given(world=corrected_worlds())
def test_corrected_events_give_the_map_of_a_log_with_the_corrections_written_in(
    world: World,
) -> None:
    raw, documents, commands = world
    of_events = (ForgetRun, ForgetKeyframes, CorrectPoses, DropDetection)
    corrections = compiled([c for c in commands if isinstance(c, of_events)])
    folded = Folded.start(Settings(**raw), corrections=corrections).extend(documents)
    written = [d for e in documents if (d := corrected(e, corrections)) is not None]
    expected = Folded.start(Settings(**raw)).extend(written)
    expected.view.corrections = corrections  # the digest names them
    assert map_digest(folded.view) == map_digest(expected.view)


@given(world=corrected_worlds())
def test_any_commands_and_their_undos_give_the_map_without_commands(world: World) -> None:
    raw, documents, commands = world
    commands = [c for c in commands if not isinstance(c, Undo)]
    undos = [
        Undo(command_id=f"u{n}", issued_by="ann@lab", undone=c.command_id)
        for n, c in enumerate(commands)
    ]
    folded = Folded.start(Settings(**raw), corrections=compiled([*commands, *undos]))
    plain = Folded.start(Settings(**raw)).extend(documents)
    assert map_digest(folded.extend(documents).view) == map_digest(plain.view)


@given(world=corrected_worlds(), seed=st.integers(0, 2**32))
def test_the_order_of_independent_commands_does_not_matter(world: World, seed: int) -> None:
    raw, documents, commands = world
    independent = [
        c for c in commands if isinstance(c, (ForgetRun, ForgetKeyframes, DropDetection, KeepApart))
    ]
    shuffled = random.Random(seed).sample(independent, len(independent))
    one, other = (
        Folded.start(Settings(**raw), corrections=compiled(each)).extend(documents)
        for each in (independent, shuffled)
    )
    assert map_digest(one.view) == map_digest(other.view)
