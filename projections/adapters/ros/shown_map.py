"""The map that a node shows: markers, objects and walls, each published when it changed."""

import time
from collections.abc import Mapping
from typing import Any

from eventsrc.record.ros_node import RosNode, RosPublisher
from projections.fold.deltas import MapGiven
from projections.map.view import MapView

from .map_messages import DETECTIONS, GRID, MARKERS, MapMessages, MarkerKey


class ShownMap:
    """Publishes maps on ``~/markers``, ``~/objects`` and, once there are walls, ``~/walls``.

    Subscribers that are there get the markers that changed, late ones all of them. Of several
    floors the walls of the first are shown.
    """

    def __init__(self, node: RosNode) -> None:
        self._node, self._messages = node, MapMessages(node.types)
        self._markers = node.publisher("~/markers", MARKERS, latched=True)
        self._objects = node.publisher("~/objects", DETECTIONS, latched=True)
        self._walls: RosPublisher | None = None
        self._shown: Mapping[MarkerKey, Any] | None = None
        self._given: MapGiven | None = None

    @property
    def topics(self) -> list[str]:
        """The topics that are published on."""
        there = (self._markers, self._objects, self._walls)
        return [each.topic for each in there if each is not None]

    def show(self, view: MapView) -> int:
        """Publish what differs from the map before; returns how many markers do."""
        messages, stamp_ns = self._messages, time.time_ns()
        markers = messages.markers(view)
        changed = messages.changed(self._shown or {}, markers)
        if changed or self._shown is None:
            whole = messages.array(markers.values())
            self._markers.publish(messages.array(changed), kept=whole)
        self._objects.publish(messages.objects(view, stamp_ns))
        self._shown = markers
        if view.map is not None and view.map != self._given:
            if self._walls is None:
                self._walls = self._node.publisher("~/walls", GRID, latched=True)
            self._walls.publish(messages.grid(view.map.map, stamp_ns))
            self._given = view.map
        return len(changed)
