"""The arrays of the web debugger, replayed row by row by a slow client, are the map at W."""

import math
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.commands import Command
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.deltas import ObjectMissing, ObjectRelocated
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import fold_events, fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.surfaces.ui.log_map import LogMap, Opened
from projections.surfaces.ui.map_answers import history_columns
from projections.surfaces.ui.requests import packed_arrays
from tests.support.logs import write_log
from tests.support.thorough import rounds
from tests.support.ui_page import ReplayedMap, as_float32, read_arrays, replay
from tests.support.walks import corrected_walks, write_mixed_log
from tests.unit.test_moved_things import ROOM, run

PAGE = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=1.0)
EVIDENCE = PAGE.with_assignments(["fusion=evidence"])
Items = list[dict[str, Any] | Command]
slow = settings(
    deadline=None, max_examples=rounds(150, 6), suppress_health_check=[HealthCheck.too_slow]
)


def answer(shown: LogMap, start: int = 0) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    header, columns = history_columns(shown.timeline.history, start, shown.log_events)
    return read_arrays(packed_arrays(header, columns))


def folded(path: Path, rules: Settings, end: int, known_at: int) -> MapView:
    with LogReader(path) as reader:
        corrections = read_corrections(reader, known_at)
        chosen = corrections.settings or rules
        return fold_log(reader, chosen, end, keep_embeddings=False, corrections=corrections)[1]


def check_same(found: ReplayedMap, view: MapView) -> None:
    """The replayed map has the view's keyframes, places, names, objects and adjacency."""
    assert found.keyframes == [(k.run_id, k.keyframe_id, k.place) for k in view.keyframes]
    assert found.poses == [
        None
        if (p := k.pose) is None
        else (as_float32(p.x_m), as_float32(p.y_m), as_float32(p.yaw_rad))
        for k in view.keyframes
    ]
    assert found.places == {p.ordinal: sorted(p.members) for p in view.places.values() if p.members}
    assert found.place_ids == {p.ordinal: p.place_id for p in view.places.values()}
    assert found.names == {p.ordinal: p.name for p in view.places.values() if p.name is not None}
    assert found.adjacency == view.adjacency
    assert found.objects.keys() == view.objects.keys()
    for ordinal, o in view.objects.items():
        at, shown = o.estimate, found.objects[ordinal]
        x, y = (o.mean_x, o.mean_y) if at is None else (at.est_x, at.est_y)
        assert (shown["x"], shown["y"]) == (as_float32(x), as_float32(y))
        if at is None:
            assert all(math.isnan(shown[name]) for name in ("xx", "xy", "yy"))
        else:
            variances = (at.var_xx_um2, at.var_xy_um2, at.var_yy_um2)
            assert [shown[name] for name in ("xx", "xy", "yy")] == [
                as_float32(variance / 1e12) for variance in variances
            ]
        assert shown["id"] == o.object_id
        assert shown["count"] == o.obs_count
        assert shown["class_name"] == o.class_name
        assert shown["place"] == o.place
        assert shown["missing"] == (o.missing_in is not None)
        assert shown["confirmed"] == o.confirmed


@pytest.mark.parametrize("rules", [PAGE, EVIDENCE], ids=["page", "evidence"])
@slow
@given(items=corrected_walks(), data=st.data())
def test_replayed_arrays_are_the_map(rules: Settings, items: Items, data: st.DataObject) -> None:
    """At any W, under all commands of the log, loaded at once or in two parts."""

    def chosen(corrections: Corrections) -> Settings:
        return corrections.settings or rules

    with tempfile.TemporaryDirectory() as folder:
        path = write_mixed_log(Path(folder) / "log", items)
        with LogMap(Opened(path, chosen)) as shown:
            shown.refresh()
            assert shown.through == len(items)
            header, arrays = answer(shown)
            split = data.draw(st.integers(0, len(items)))
            later_header, later = answer(shown, split)
            for end in data.draw(st.lists(st.integers(0, len(items)), min_size=1, max_size=4)):
                found = replay(header, arrays, end)
                view = folded(path, rules, end, len(items))
                check_same(found, view)
                event(f"merged: {bool(view.survivors.absorbed_by)}")
            for name, values in arrays.items():
                both = rows(arrays, name, split) + later[name]
                assert list(map(repr, both)) == list(map(repr, values)), name  # NaN too
            for kind in ("place_id", "object_id", "place_founder"):
                known = later_header["first"].get(kind, later_header["first"]["place_id"])
                whole = header["strings"][kind]
                assert whole[:known] + later_header["strings"][kind] == whole
            assert later_header["strings"]["class"] == header["strings"]["class"]


def test_things_that_go_missing_and_move(tmp_path: Path) -> None:
    """At many W of a log in which things are carried away and come back."""
    moved = {**ROOM, "chair": (5.0, 1.6)}
    gone = {name: where for name, where in ROOM.items() if name != "plant"}
    rooms = {"run-a": ROOM, "run-b": moved, "run-c": gone, "run-d": ROOM}
    documents = [each for name, room in rooms.items() for each in run(name, room)]
    path = write_log(tmp_path / "log", documents)
    rules = Settings(fusion="evidence")
    with LogMap(Opened(path, lambda _: rules)) as shown, LogReader(path) as reader:
        shown.refresh()
        header, arrays = answer(shown)
        view = MapView(rules, keep_embeddings=False)
        missing = located = 0
        for folded_event in fold_events(reader.read(), SemanticMap(rules)):
            view.apply_event(folded_event.offset, folded_event.deltas)
            kinds = {type(delta) for delta in folded_event.deltas}
            if kinds & {ObjectMissing, ObjectRelocated} or folded_event.offset % 50 == 0:
                check_same(replay(header, arrays, view.next_offset), view)
                missing += any(o.missing_in is not None for o in view.objects.values())
                located += ObjectRelocated in kinds
        assert missing
        assert located
        kinds = {header["kinds"][kind] for kind in arrays["ev_kind"]}
        assert {"object_missing", "object_moved", "run_began"} <= kinds


def rows(arrays: dict[str, list[Any]], name: str, split: int) -> list[Any]:
    """The rows of events below ``split``."""
    offsets = arrays[f"{name.partition('_')[0]}_offset"]
    return [value for value, at in zip(arrays[name], offsets, strict=True) if at < split]
