"""Many commands of a kind: what they cost grows with their number."""

import random
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import (
    Anchor,
    CorrectPoses,
    ForgetRun,
    RigidTransform,
    Undo,
    UndoMerge,
    UseSettings,
    encode_command,
)
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import NEVER, LogReader, LogWriter
from projections.edit.current import MapToEdit
from projections.edit.effect import edits_document, edits_text, effect_keys, effects_of
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.rule_folds import Rules, fold_in_this_process
from projections.localize.calibrate.rounds import calibrate
from projections.map.digest import map_digest
from projections.map.fold import fold_events, fold_log, new_map
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.postgres.connection import Targets
from projections.postgres.inputs import LogInputs
from projections.postgres.live_fold import LiveFold
from projections.postgres.live_tail import tail
from projections.postgres.rebuild import rebuild
from scripts.programs.bench.commands import (
    KINDS,
    commands_of,
    large_undo_merge,
    mixed,
    name_place,
    undone,
    write_log,
)
from tests.support.logs import command, sample_drive, write_rooms

SAMPLE = sample_drive()
EVERY = {**KINDS, "mixed": mixed}


def calls_of(work: Callable[[], object]) -> int:
    """The number of functions that are called, of Python and C."""
    number = 0

    def count(_: Any, event: str, __: Any) -> None:
        nonlocal number
        number += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return number


def settings_of(corrections: Corrections) -> Settings:
    return corrections.settings or Settings()


@pytest.mark.parametrize("given", [commands_of, undone])
@pytest.mark.parametrize("kind", EVERY.values(), ids=EVERY)
def test_twice_the_commands_are_about_twice_the_work(kind: Any, given: Any) -> None:
    """Compiling them, their fingerprint, a map without events and the list of them."""
    events = [RecordedCommand(n, c) for n, c in enumerate(given(kind, 400))]

    def all_of(commands: list[RecordedCommand]) -> None:
        corrections = compile_corrections(commands)
        corrections.fingerprint()
        SemanticMap(Settings(), corrections)
        with LogReader(SAMPLE) as reader:
            current = MapToEdit(reader, settings_of, commands=commands, corrections=corrections)
            found = effects_of(current, known_only=True)
        times = {recorded.offset: 0 for recorded in commands}
        edits_document(found, times)
        edits_text(found, times)

    all_of(events[:10])  # what is imported and cached
    half, whole = (calls_of(lambda n=n: all_of(events[:n])) for n in (len(events) // 2, None))
    assert whole < 2.6 * half


def test_undone_merges_of_all_keyframes_are_compiled_as_sets() -> None:
    """445 keyframes are 98,790 pairs; 20 commands of them are fewer calls than one has pairs."""
    events = [RecordedCommand(n, c) for n, c in enumerate(commands_of(large_undo_merge, 20))]
    assert calls_of(lambda: compile_corrections(events)) < 98_790


def test_memory_of_undone_merges_grows_with_their_anchors() -> None:
    """20 of 500 anchors each are 2,495,000 pairs."""
    events = [
        RecordedCommand(
            Offset(n),
            command(
                UndoMerge,
                merge_offset=Offset(0),
                places=tuple(
                    Anchor(run_id=RunId("a"), keyframe_id=KeyframeId(500 * n + k))
                    for k in range(500)
                ),
            ),
        )
        for n in range(20)
    ]
    tracemalloc.start()
    try:
        SemanticMap(Settings(), compile_corrections(events))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 20_000_000


def chains(n: int) -> list[RecordedCommand]:
    """Transforms of a run and of parts of it, and stated poses, more than are applied singly."""
    given = []
    for number in range(n):
        transform = RigidTransform.of(0.001 * number, 0.01, 0.1)
        span = [None, KeyframeId(number % 24)][:: (-1) ** number]
        given.append(
            command(
                CorrectPoses,
                run_id=RunId("run-a"),
                transform=transform,
                first=span[0],
                last=span[1],
            )
        )
    return [RecordedCommand(30 + number, each) for number, each in enumerate(given)]


def test_poses_corrected_together_make_the_map_of_poses_corrected_one_by_one(
    tmp_path: Path,
) -> None:
    corrections = compile_corrections(chains(150))
    with LogReader(write_rooms(tmp_path / "log")) as reader:
        together = map_digest(fold_log(reader, Settings(), corrections=corrections)[1])
        view = MapView(Settings(), corrections=corrections)
        for folded in fold_events(reader.read(), new_map(reader, Settings(), corrections)):
            view.apply_event(folded.offset, folded.deltas)
    assert together == map_digest(view)
    assert corrections.poses[RunId("run-a")].are_many


def test_every_fold_of_a_log_corrects_poses_together(
    tmp_path: Path, one_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_rooms(tmp_path / "log")
    with LogWriter(log, fsync=NEVER) as writer:
        for _, each in chains(150):
            writer.append(COMMAND_KEY, encode_command(each))
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        one_by_one = MapView(Settings(), corrections=corrections)
        for folded in fold_events(reader.read(), new_map(reader, Settings(), corrections)):
            one_by_one.apply_event(folded.offset, folded.deltas)
        digest = map_digest(one_by_one)

        def alone(*_: object) -> None:
            raise AssertionError("a pose was corrected alone")

        monkeypatch.setattr(Corrections, "pose", alone)
        assert map_digest(fold_log(reader, Settings(), corrections=corrections)[1]) == digest
        rules = [Rules(Settings(), corrections), Rules(Settings())]
        (found, _) = fold_in_this_process(log, rules, reader.next_offset)
        assert found.digest == digest
        calibrate(reader, Settings(), corrections)
    assert rebuild(log, one_database, Settings()).digest == digest


def test_the_key_of_an_effect_is_of_the_commands_up_to_it_and_of_the_options() -> None:
    named = [command(UseSettings, settings={"eps_m": eps}) for eps in (1.0, 1.5, 1.0)]
    commands = [RecordedCommand(n, each) for n, each in enumerate([*named, *named])]
    keys = list(effect_keys(settings_of, commands))
    assert len(set(keys)) == len(commands)
    assert list(effect_keys(settings_of, commands[:2])) == keys[:2]

    def set_eps(corrections: Corrections) -> Settings:
        return settings_of(corrections).with_assignments(["eps_m=1.5"])

    others = list(effect_keys(set_eps, commands))
    assert not set(others) & set(keys), "the same settings now, but not under each command"
    moved = [RecordedCommand(each.offset + 1, each.command) for each in commands]
    assert not set(effect_keys(settings_of, moved)) & set(keys)


def test_why_reads_the_times_of_all_commands_together(tmp_path: Path) -> None:
    """As many calls for twice the commands, but for twice the entries."""

    def calls(count: int) -> int:
        log = write_log(tmp_path / str(count), commands_of(KINDS["name-place"], count))
        with LogTimeline(log, cache=False) as timeline:
            known = timeline.knowing()
            _ = known.history
            return calls_of(lambda: known.why("sim-7-a_p0"))

    calls(1)
    assert calls(200) < 2.6 * calls(100)


def test_few_compiled_corrections_are_kept(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", commands_of(KINDS["name-place"], 50))
    with LogTimeline(log) as timeline:
        for known_at in range(445, 496):
            found = timeline.corrections(Offset(known_at))
            assert len(found.in_force) == known_at - 445
        assert len(timeline._compiled) <= 16


@pytest.mark.seconds
def test_undos_of_undos_of_any_depth_are_followed(tmp_path: Path, one_database: Targets) -> None:
    log = write_rooms(tmp_path / "log")
    with LogWriter(log, fsync=NEVER) as writer:
        own = {"issued_by": "ann"}
        forgotten = ForgetRun(**own, command_id="c0", run_id=RunId("run-a"))
        writer.append(COMMAND_KEY, encode_command(forgotten))
        for number in range(1, 5_001):
            undo = Undo(**own, command_id=f"c{number}", undone=f"c{number - 1}")
            writer.append(COMMAND_KEY, encode_command(undo))
    with LogReader(log) as reader:
        digests = []
        for known in (reader.next_offset, Offset(reader.next_offset - 1)):
            corrections = read_corrections(reader, known)
            digests.append(map_digest(fold_log(reader, Settings(), corrections=corrections)[1]))
    assert digests[0] != digests[1]
    assert rebuild(log, one_database, Settings()).digest == digests[0]
    assert tail(log, one_database, Settings(), once=True).next_offset == reader.next_offset


def test_a_name_that_comes_live_costs_no_more_for_those_before_it() -> None:
    given = [
        RecordedCommand(Offset(445 + n), c) for n, c in enumerate(commands_of(name_place, 600))
    ]
    with LogReader(SAMPLE) as reader:
        inputs = LogInputs.read(reader, Settings())
        fold = LiveFold(Settings(), reader=reader)
        assert not any(fold.feed(list(reader.read())))

    def name(commands: list[RecordedCommand]) -> None:
        for recorded in commands:
            before = inputs.latest
            fold.skip(recorded.offset)
            inputs.extend([recorded], Offset(recorded.offset + 1))
            assert before.differs_only_in_names(inputs.latest)
            fold.use_names(recorded.offset, inputs.latest.corrections)

    name(given[:50])
    first = calls_of(lambda: name(given[50:100]))
    name(given[100:550])
    assert calls_of(lambda: name(given[550:])) < 1.5 * first
    again = LiveFold(Settings(), corrections=compile_corrections(given))
    with LogReader(SAMPLE) as reader:
        assert not any(again.feed(list(reader.read())))
    assert [p.name for p in fold.view.all_places] == [p.name for p in again.view.all_places]
    assert map_digest(fold.view) == map_digest(again.view)


@pytest.mark.parametrize("seed", range(20))
def test_inputs_that_grow_by_a_command_are_those_of_all_commands(seed: int) -> None:
    """With ids that come twice, undos before their commands and of them, and names between."""
    chance = random.Random(seed)
    given: list[RecordedCommand] = []
    for number in range(40):
        kind = chance.choice(["name-place", "name-place", "keep-apart", "undo-of-nothing"])
        made = KINDS[kind](chance, number).model_copy(
            update={"command_id": f"c{chance.randrange(60)}"}
        )
        if kind == "undo-of-nothing":
            made = made.model_copy(update={"undone": f"c{chance.randrange(60)}"})
        given.append(RecordedCommand(Offset(number), made))
    inputs = LogInputs([], lambda _: Settings(), Offset(0))
    at = 0
    while at < len(given):
        end = min(at + chance.randrange(1, 4), len(given))
        inputs.extend(given[at:end], Offset(end))
        at, found = end, inputs.latest.corrections
        expected = compile_corrections(given[:end])
        assert found.in_force == expected.in_force
        assert found.names == expected.names
        assert found.fingerprint() == expected.fingerprint()
