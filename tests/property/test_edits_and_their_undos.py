"""Any commands given one after another, each made from the map as the ones before left it: their
effects are those of whole folds, and undone in any order the map is what it was."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import Command
from eventsrc.log import LogReader
from projections.edit import make as by
from projections.edit.correct_poses import Span, by_transform
from projections.edit.current import MapToEdit
from projections.edit.effect import Change, effect_of
from projections.edit.make import Stamp
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from tests.support.logs import EVENTS, FAR, LEFT, RIGHT, append, make, write_rooms
from tests.support.thorough import examples

PLACES = st.sampled_from([LEFT, RIGHT, FAR, "run-a:3", "run-a:12", "run-b:4", "run-a:24"])
OBJECTS = st.sampled_from(
    ["cup-1", "cup-2", "cup-3", "lamp-1", "obj-2237cc2f33929b56", "obj-dc4cb3fc37c4dc9a"]
)
IDS = st.integers(0, 25)
EDITS: st.SearchStrategy[tuple[Callable[..., Command], tuple[Any, ...]]] = st.one_of(
    st.tuples(st.just(by.name_place), st.tuples(PLACES, st.sampled_from(["hall", "bath"]))),
    st.tuples(st.just(by.keep_apart), st.tuples(PLACES, PLACES)),
    st.tuples(st.just(by.join), st.tuples(PLACES, PLACES)),
    st.tuples(st.just(by.undo_merge), st.tuples(st.integers(15, 25))),
    st.tuples(st.just(by.same_object), st.tuples(OBJECTS, OBJECTS)),
    st.tuples(st.just(by.different_objects), st.tuples(OBJECTS, OBJECTS)),
    st.tuples(st.just(by.drop_object), st.tuples(OBJECTS)),
    st.tuples(st.just(by.drop_detection), st.tuples(st.lists(OBJECTS, min_size=1, max_size=2))),
    st.tuples(
        st.just(by.relabel),
        st.tuples(
            st.dictionaries(
                st.sampled_from(["cup", "lamp", "17"]), st.sampled_from(["cup", "mug"]), min_size=1
            )
        ),
    ),
    st.tuples(st.just(by.forget_run), st.tuples(st.sampled_from(["run-a", "run-b"]))),
    st.tuples(
        st.just(by.forget_keyframes),
        st.tuples(st.just("run-a"), st.builds("{}..{}".format, IDS, IDS)),
    ),
    st.tuples(
        st.just(by_transform),
        st.tuples(
            st.sampled_from(["run-a", "run-b"]),
            st.builds(Span, st.none() | IDS, st.none() | IDS),
            st.sampled_from([0.0, 0.25, -40.0]),
            st.sampled_from([0.0, -20.0]),
            st.sampled_from([0.0, 0.1]),
        ),
    ),
    st.tuples(
        st.just(by.use_settings),
        st.tuples(
            st.builds(
                Settings,
                eps_m=st.sampled_from([0.6, 1.5, 30.0]),
                fusion=st.sampled_from(["page", "evidence"]),
            )
        ),
    ),
)


def _settings(corrections: Corrections) -> Settings:
    return corrections.settings or Settings()


def _map(log: Path) -> MapView:
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return fold_log(reader, _settings(corrections), corrections=corrections)[1]


def _map_of_robots_events(log: Path) -> str:
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return map_digest(
            fold_log(reader, _settings(corrections), EVENTS, corrections=corrections)[1]
        )


@settings(max_examples=examples(60))
@given(edits=st.lists(EDITS, min_size=1, max_size=6), data=st.data())
def test_undone_in_any_order_they_leave_nothing(
    edits: list[tuple[Callable[..., Command], tuple[Any, ...]]],
    data: st.DataObject,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    log = write_rooms(tmp_path_factory.mktemp("rooms") / "log")
    untouched = _map_of_robots_events(log)
    given_ids = []
    for number, (function, args) in enumerate(edits):
        with LogReader(log) as reader:
            current = MapToEdit(reader, _settings)
            try:
                command = function(current, Stamp(f"c{number}", "me@here", "why"), *args)
            except MisuseError:
                continue
            effect = Change.by(current, command).effect()
        before = _map(log)
        append(log, command)
        assert effect == effect_of(before, _map(log))
        given_ids.append(f"c{number}")
    for number, command_id in enumerate(data.draw(st.permutations(given_ids))):
        append(log, make(log, by.undo, command_id, command_id=f"u{number}"))
    assert _map_of_robots_events(log) == untouched
