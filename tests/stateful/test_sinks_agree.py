"""Memory, one database and two databases: after any steps their rows are equal.

The machine writes events (walks, merges, duplicates, conflicts, unreadable ones) and commands, also
some that change the rule by which observations are fused; it tails in batches of any size, crashes
tails at any statement, rebuilds to any offset, and compares.
The memory sink gets each event once, in order, from the start again where a command changes more
than names; the databases get crashes, retries, rebuilds and refolds.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psycopg
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from eventsrc.envelope.commands import Command, SameObject, UseSettings
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.map.parsing import read_corrections
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets, connect
from projections.postgres.live_fold import LiveFold
from tests.support.envelopes import envelope
from tests.support.logs import (
    append_command,
    append_raw,
    bridge,
    command,
    forget_keyframes,
    keep_apart,
    name_place,
    undo,
    walk,
    write_log,
)
from tests.support.memory_sink import MemorySink, MemoryTables
from tests.support.rows import ORDER, graph_rows, vector_rows, wait_for_drops
from tests.support.thorough import THOROUGH

EXAMPLES = int(os.environ.get("MAPFOLD_STATEFUL_EXAMPLES", "8" if THOROUGH else "4"))
PLACES = st.sampled_from(["one", "two"])


def settings_of(corrections: Corrections) -> Settings:
    """The log's settings, else the defaults."""
    return corrections.settings or Settings()


class Crash(Exception):
    """Simulates the death of the tail's process."""


class Bomb:
    """Raises `Crash` at the n-th statement that psycopg sends."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int) -> None:
        self.left = at
        for method in ("execute", "copy"):
            patch.setattr(psycopg.Cursor, method, self._stepping(getattr(psycopg.Cursor, method)))

    def _stepping(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def step(*args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if self.left < 0:
                raise Crash
            return original(*args, **kwargs)

        return step


class SinksAgree(RuleBasedStateMachine):
    targets: dict[str, Targets]

    @initialize(fusion=st.sampled_from(["page", "evidence"]))
    def begin(self, fusion: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="mapfold-agree-"))
        self.log = write_log(self.folder / "log", walk(3, seed=99, run_id="first"))
        self.keyframes = {"run-a": 0, "run-b": 0}
        self.unreadable = False
        self.given: list[Command] = []
        if fusion != "page":
            self._give(command(UseSettings, settings={"fusion": fusion}))
        self.fold, self.memory = LiveFold(Settings()), MemoryTables()
        for name in self.targets:
            self._empty(self.targets[name])

    def _empty(self, targets: Targets) -> None:
        wait_for_drops(targets)
        for url in {targets.graph_url, targets.vector_url}:
            with connect(url, autocommit=True) as connection:
                connection.execute("SET client_min_messages = warning")
                connection.execute("SET search_path = ag_catalog, public")
                connection.execute("SELECT drop_graph(name, true) FROM ag_graph")
                connection.execute("DROP SCHEMA IF EXISTS mapfold CASCADE")
                connection.execute("DROP TABLE IF EXISTS public.detection_embeddings")

    @rule(run=st.sampled_from(["run-a", "run-b"]), count=st.integers(1, 12), seed=st.integers(0, 9))
    def robot_walks(self, run: str, count: int, seed: int) -> None:
        first = self.keyframes[run]
        self.keyframes[run] += count
        write_log(self.log, walk(count, seed=seed, run_id=run, first=first))

    @rule(start=st.integers(0, 15))
    def rooms_are_joined(self, start: int) -> None:
        first = self.keyframes["run-b"]
        self.keyframes["run-b"] += 6
        joining = enumerate(bridge()[start : start + 6])
        documents = [{**d, "keyframe_id": first + i} for i, d in joining]
        write_log(self.log, documents)

    @rule(conflict=st.booleans())
    def keyframe_comes_twice(self, conflict: bool) -> None:
        write_log(self.log, [envelope(0, 1.0 if conflict else None, run_id="first")] * 2)

    @rule()
    def unreadable_event_comes(self) -> None:
        append_raw(self.log, b'{"run_id": "broken"}')
        self.unreadable = True

    @rule(keyframe=st.integers(0, 20), name=st.sampled_from(["kitchen", "hall"]))
    def place_is_named(self, keyframe: int, name: str) -> None:
        self._give(name_place(keyframe, name))

    @rule(first=st.integers(0, 20), count=st.integers(0, 8))
    def keyframes_are_forgotten(self, first: int, count: int) -> None:
        self._give(forget_keyframes(first, first + count))

    @rule(first=st.integers(0, 20), second=st.integers(0, 20))
    def places_are_kept_apart(self, first: int, second: int) -> None:
        if first != second:
            self._give(keep_apart(first, second))

    @rule(fusion=st.sampled_from(["page", "evidence"]), range_m=st.sampled_from([1.0, 3.0]))
    def fusion_is_changed(self, fusion: str, range_m: float) -> None:
        given = {"fusion": fusion, "evidence": {"range_m": range_m}}
        self._give(command(UseSettings, settings=given))

    @rule(first=st.integers(0, 20), second=st.integers(0, 20))
    def objects_are_made_one(self, first: int, second: int) -> None:
        if first != second:
            det_ids = f"run-a_kf{first}_d0", f"run-a_kf{second}_d0"
            self._give(command(SameObject, det_ids=det_ids))

    @rule(index=st.integers(0, 20))
    def command_is_undone(self, index: int) -> None:
        if self.given:
            self._give(undo(self.given[index % len(self.given)]))

    def _give(self, given: Command) -> None:
        self.given.append(given)
        append_command(self.log, given)

    @rule(name=PLACES, size=st.integers(1, 20))
    def tail_catches_up(self, name: str, size: int) -> None:
        self._tail(name, size)

    @rule(name=PLACES, size=st.integers(1, 20), at=st.integers(0, 80))
    def tail_crashes(self, name: str, size: int, at: int) -> None:
        with pytest.MonkeyPatch.context() as patch:
            Bomb(patch, at)
            with contextlib.suppress(Crash):
                self._tail(name, size)

    @rule(name=PLACES, size=st.integers(1, 20), only=st.sampled_from(["graph", "vectors"]))
    def one_sink_goes_ahead(self, name: str, size: int, only: Any) -> None:
        tail(
            self.log,
            self.targets[name],
            settings_of,
            once=True,
            only=only,
            batch_events=size,
        )

    @rule(name=PLACES, until=st.none() | st.integers(0, 40))
    def rebuild_to_some_offset(self, name: str, until: int | None) -> None:
        try:
            rebuild(self.log, self.targets[name], settings_of, until=until)
        except FoldError:
            assert self.unreadable

    @rule(name=PLACES, at=st.integers(0, 150))
    def rebuild_crashes(self, name: str, at: int) -> None:
        with pytest.MonkeyPatch.context() as patch:
            Bomb(patch, at)
            with contextlib.suppress(Crash, FoldError):
                rebuild(self.log, self.targets[name], settings_of)

    @rule(size=st.integers(1, 20))
    def all_agree_once_caught_up(self, size: int) -> None:
        self._memory_catches_up()
        graph = {
            label: [_values(row) for _, row in sorted(self.memory.graph[label].items())]  # type: ignore[index]
            for label in ORDER
        }
        vectors = [
            (r.det_pk, r.added.det_id, r.added.class_name, list(r.bbox), r.ingested_at)
            for _, r in sorted(self.memory.vectors.items())
        ]
        for name, targets in self.targets.items():
            self._tail(name, size)
            found = graph_rows(targets.graph_url)
            assert {label: [_values(row) for row in rows] for label, rows in found.items()} == graph
            rows = vector_rows(targets.vector_url)
            assert [(r[0], r[2], r[4], r[6], r[-1]) for r in rows] == vectors

    @invariant()
    def memory_counts_what_the_view_counts(self) -> None:
        if self.memory.next_offset:
            counts = self.fold.view.counts()
            assert len(self.memory.graph["IN_PLACE"]) == counts["IN_PLACE"]
            assert len(self.memory.graph["ADJACENT_TO"]) == counts["ADJACENT_TO"]
            assert len(self.memory.graph["Place"]) == counts["places"]

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def _tail(self, name: str, size: int) -> None:
        tail(
            self.log,
            self.targets[name],
            settings_of,
            once=True,
            batch_events=size,
        )

    def _memory_catches_up(self) -> None:
        with LogReader(self.log) as reader:
            corrections = read_corrections(reader)
            settings = settings_of(corrections)
            if settings != self.fold.map.settings or not corrections.differs_in_names_only(
                self.fold.map.corrections
            ):
                self.fold = LiveFold(settings, corrections=corrections)
                self.memory = MemoryTables()
            for event in reader.read(self.memory.next_offset):
                for _ in self.fold.feed([event]):
                    pass
        if self.fold.map.next_offset:
            self.fold.use_names(Offset(self.fold.map.next_offset - 1), corrections)
        MemorySink().prepare(self.fold.tracker.drain(), self.fold.view).send(self.memory)
        self.memory.next_offset = self.fold.map.next_offset


def _values(row: tuple[Any, ...]) -> tuple[Any, ...]:
    return (*map(int, row[:-1]), json.dumps(json.loads(row[-1]), sort_keys=True))


@pytest.fixture
def machine(third_database: Targets, two_databases: Targets) -> type[SinksAgree]:
    """One database with COPY, two with INSERT; each example starts with them empty."""
    targets = {"one": third_database, "two": two_databases}
    return type("Machine", (SinksAgree,), {"targets": targets})


@pytest.mark.timeout(900)
def test_memory_and_all_databases_have_the_same_rows(machine: type[SinksAgree]) -> None:
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=EXAMPLES,
            stateful_step_count=14,
            deadline=None,
            # Not shrunk: each example takes seconds, and the steps are told as they are.
            phases=(Phase.explicit, Phase.reuse, Phase.generate),
            suppress_health_check=list(HealthCheck),
        ),
    )
