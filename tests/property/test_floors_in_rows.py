"""Rows of the graph of a building with floors: what the view says, in batches and rebuilt."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.view import MapView
from tests.property.test_floors import buildings, drive
from tests.support.logs import write_log
from tests.support.rows import expected_graph, followed_and_rebuilt, memory_rows


@given(building=buildings(), size=st.integers(1, 9))
def test_batches_and_a_rebuild_have_the_rows_of_the_view(
    building: tuple[dict[str, Any], list[dict[str, Any]]], size: int
) -> None:
    raw, documents = building
    settings = Settings(**raw)
    with TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        live, fresh = followed_and_rebuilt(log, settings, size)
        with LogReader(log) as reader:
            view = fold_log(reader, settings)[1]
    assert live.graph == fresh.graph
    assert memory_rows(live) == expected_graph(view)


def graph_of(tmp_path: Path, *floors: dict[str, Any]) -> tuple[MapView, Any]:
    log = write_log(tmp_path / "log", drive(*floors))
    with LogReader(log) as reader:
        view = fold_log(reader, Settings())[1]
    return view, memory_rows(followed_and_rebuilt(log, Settings(), 4)[0])


def test_places_are_part_of_their_floor_and_floors_of_the_building(tmp_path: Path) -> None:
    _, rows = graph_of(tmp_path, {"floor": "ground"}, {"map_z": 3.1})
    (building,) = rows["Building"]
    names = {row[0]: row[1]["floor"] for row in rows["Floor"]}
    places = {row[0]: row[1]["floor"] for row in rows["Place"]}
    assert sorted(names.values()) == ["1", "ground"]
    assert {(places.get(a, "a floor"), names.get(b, b)) for _, a, b, _ in rows["PART_OF"]} == {
        ("ground", "ground"),
        ("1", "1"),
        ("a floor", building[0]),
    }
    ((*_, edge),) = rows["ADJACENT_TO"]
    assert edge == {"shared_transitions": 1, "between_floors": True}
    assert {row[1]["floor"] for row in rows["Pose"]} == {"1", "ground"}


def test_without_floors_places_are_part_of_the_building_and_say_no_floor(tmp_path: Path) -> None:
    _, rows = graph_of(tmp_path, {})
    assert rows["Floor"] == []
    assert [row[1:] for row in rows["PART_OF"]] == [
        (rows["Place"][0][0], rows["Building"][0][0], {})
    ]
    assert "floor" not in rows["Place"][0][1]
    assert all("floor" not in row[1] for row in rows["Pose"])
