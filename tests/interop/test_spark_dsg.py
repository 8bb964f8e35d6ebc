"""spark_dsg reads the scene graph of `mapfold export --dsg`."""

from pathlib import Path
from typing import Any

import pytest

from projections.surfaces.python.map import fold
from tests.support.commands import Commands
from tests.support.logs import SAMPLE

pytestmark = pytest.mark.slow


def test_it_loads_the_exported_map(tmp_path: Path) -> None:
    dsg: Any = pytest.importorskip("spark_dsg")
    run = Commands.in_folder(tmp_path)
    run("export", str(SAMPLE), "--preset", "full", "--dsg", "map.json")
    graph = dsg.DynamicSceneGraph.load(tmp_path / "map.json")
    view = fold(SAMPLE, preset="full").view
    rooms, poses, objects = (
        [*graph.get_layer(layer).nodes]
        for layer in (dsg.DsgLayers.ROOMS, dsg.DsgLayers.PLACES, dsg.DsgLayers.OBJECTS)
    )
    confirmed = {o.object_id: o for o in view.objects.values() if o.confirmed}
    assert {node.attributes.metadata.get()["place_id"] for node in rooms} == {
        place.place_id for place in view.places.values()
    }
    assert len(poses) == sum(len(place.members) for place in view.places.values())
    assert {node.attributes.metadata.get()["object_id"] for node in objects} == confirmed.keys()
    for node in objects:
        found = confirmed[node.attributes.metadata.get()["object_id"]]
        assert tuple(node.attributes.position[:2]) == pytest.approx(found.spot)
        assert node.attributes.name == found.class_name
        if found.place is not None:
            pose = graph.get_node(node.get_parent())
            room = graph.get_node(pose.get_parent())
            assert room.attributes.metadata.get()["place_id"] == view.place_id(found.place)
    links = sum(len(node.siblings()) for node in rooms) // 2
    assert links == len(view.edges())
