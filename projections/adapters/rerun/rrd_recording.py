"""A recording of how a map came about, an .rrd file for the Rerun viewer.

| path | what |
|---|---|
| ``map/…``, ``floors/…``, ``graph`` | the map (`parts`); an entity is logged where it changed |
| ``changes`` | one line for each change of the map |
| ``counts/places``, ``counts/objects`` | after each event |
| ``lag`` | seconds from a robot's event to its being written into the log |

Timelines: ``offset`` is the number of events that the map is of, as in ``--at``; ``stamp`` is the
robots' time (`Moments`). The same log gives the same data, but not the same bytes: Rerun numbers
its chunks and rows at random.
"""

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path as File
from typing import Final

import numpy as np
import rerun
from numpy.typing import NDArray
from rerun import blueprint

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import visible
from eventsrc.base.user_files import OutputFile, written_whole
from eventsrc.log import Event
from projections.map.fold import RecordedFold
from projections.map.phrases import change_lines
from projections.map.view import MapView

from .parts import Arrow, Dots, Graph, Lines, Part, Path, map_parts, robot_parts

APPLICATION: Final = "mapfold"
_MARGIN_M: Final = 1.0
_PIPED_BYTES: Final = 1 << 20
_NEVER: Final = timedelta(days=1_000)
"""Rerun ends a chunk at a size or after a time; by size alone the same log gives the same
chunks."""
_INK: Final = 0x22262BFF
_PAPER: Final = 0xFFFFFFFF
_SERIES: Final = (
    ("counts/places", 0x3B82C4FF),
    ("counts/objects", 0xE08A1EFF),
    ("lag", 0x7A63C7FF),
)
_Y_UP: Final = rerun.Transform3D(scale=[1.0, -1.0, 1.0])
"""Rerun's 2D view has y downwards."""


def write_recording(
    fold: RecordedFold, path: File, recording_id: str, *, everything: bool = False
) -> int:
    """Record the maps of a fold; returns the number of scenes.

    Maps have Objects that are not confirmed only with ``everything``.
    The viewer shows two recordings of one ``recording_id`` as one. Raises FoldError at an
    event that cannot be folded, and what `written_whole` raises.
    """
    was_strict = rerun.strict_mode()
    rerun.set_strict_mode(True)
    try:
        recording = rerun.RecordingStream(
            APPLICATION,
            recording_id=recording_id,
            send_properties=False,
            batcher_config=rerun.ChunkBatcherConfig(flush_tick=_NEVER),
        )
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        with written_whole(path) as file, _copied_to(file) as pipe:
            recording.save(pipe, default_blueprint=_blueprint())
            try:
                scenes = _record(fold, recording, everything=everything)
                recording.flush()
            finally:
                recording.disconnect()  # closes the pipe, for whose end `_copied_to` waits
    finally:
        rerun.set_strict_mode(was_strict)
    return scenes


@contextmanager
def _copied_to(file: OutputFile) -> Iterator[File]:
    """The path of a pipe; what Rerun saves to it is written to ``file``. Rerun itself prints where
    a write fails, and may wait for ever for its own thread."""
    failed: list[Exception] = []
    reading, writing = os.pipe()

    def copy() -> None:
        with open(reading, "rb", buffering=0) as pipe:  # noqa: PTH123  # no path
            while data := pipe.read(_PIPED_BYTES):
                try:
                    if not failed:
                        file.write(data)
                except (MapfoldError, OSError) as error:
                    failed.append(error)  # the rest is read and dropped

    copying = threading.Thread(target=copy, name="copy of a recording")
    copying.start()
    try:
        yield File(f"/dev/fd/{writing}")
    finally:
        os.close(writing)
        copying.join()
    if failed:
        raise failed[0]


def _record(fold: RecordedFold, recording: rerun.RecordingStream, *, everything: bool) -> int:
    series, scenes = _Series(), 0
    recording.send_recording_start_time_nanos(fold.moments.span_ns[0])
    the_map, robot = _Shown(recording), _Shown(recording)
    for root in ("map", "floors"):
        recording.log(root, _Y_UP, static=True)
    for event, now, deltas, is_scene in fold:
        recording.set_time("offset", sequence=fold.view.next_offset)
        recording.set_time("stamp", timestamp=np.datetime64(now, "ns"))
        for line in change_lines(fold.view, deltas):
            recording.log("changes", rerun.TextLog(line, level="INFO"))
        robot.show(robot_parts(fold.view))
        series.add(fold.view, event, now)
        if is_scene:
            the_map.show(map_parts(fold.view, everything=everything))
            scenes += 1
    series.send(recording)
    recording.send_blueprint(_blueprint(fold.view))
    return scenes


class _Shown:
    """The parts last logged in a recording; an entity is logged again only if its part changed."""

    def __init__(self, recording: rerun.RecordingStream) -> None:
        self._recording = recording
        self._parts: dict[Path, Part] = {}

    def show(self, parts: dict[Path, Part]) -> None:
        for path, part in parts.items():
            if self._parts.get(path) != part:
                for shape in _shapes(part):
                    self._recording.log(rerun.new_entity_path([*path]), shape)
        for path in self._parts.keys() - parts.keys():
            self._recording.log(rerun.new_entity_path([*path]), rerun.Clear(recursive=False))
        self._parts = parts


def _shapes(part: Part) -> Iterator[rerun.AsComponents]:
    match part:
        case Dots():
            yield rerun.Points2D(
                part.spots,
                colors=_colours(part.colours),
                radii=part.radius_m,
                labels=part.labels,
                show_labels=part.labels is not None,
            )
        case Lines():
            yield rerun.LineStrips2D(part.strips, colors=_colours(part.colours), radii=part.radii_m)
        case Arrow():
            yield rerun.Arrows2D(
                origins=[part.spot], vectors=[part.vector], colors=_INK, radii=0.06
            )
        case Graph():
            yield rerun.GraphNodes(
                part.ids,
                positions=part.spots,
                colors=_colours(part.colours),
                labels=part.labels,
                show_labels=True,
            )
            yield rerun.GraphEdges(part.edges, graph_type="undirected")


def _colours(colours: Iterable[str]) -> NDArray[np.uint32]:
    return np.array([int(colour[1:] + "ff", 16) for colour in colours], dtype=np.uint32)


class _Series:
    """Numbers after each event, sent together: that is much quicker, and makes smaller files."""

    def __init__(self) -> None:
        self._series = {name: _Column() for name, _ in _SERIES}

    def add(self, view: MapView, event: Event, time_ns: int) -> None:
        values: dict[str, float] = {
            "counts/places": len(view.places),
            "counts/objects": len(view.objects),
        }
        if event.is_envelope:
            values["lag"] = (event.logged_ns - event.stamp_ns) / 1e9
        for name, value in values.items():
            column = self._series[name]
            column.offsets.append(view.next_offset)
            column.times_ns.append(time_ns)
            column.values.append(value)

    def send(self, recording: rerun.RecordingStream) -> None:
        for name, colour in _SERIES:
            column = self._series[name]
            recording.log(name, rerun.SeriesLines(colors=colour, names=name), static=True)
            if column.offsets:
                stamps = np.array(column.times_ns, dtype="datetime64[ns]")
                recording.send_columns(
                    name,
                    indexes=[
                        rerun.TimeColumn("offset", sequence=column.offsets),
                        rerun.TimeColumn("stamp", timestamp=stamps),
                    ],
                    columns=rerun.Scalars.columns(scalars=column.values),
                )


@dataclass(frozen=True, slots=True)
class _Column:
    offsets: list[int] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


def _blueprint(view: MapView | None = None) -> blueprint.Blueprint:
    """The map, a tab for each floor that has a name, and the graph; beside them the series and what
    changed. A map's view begins at the root, because the transform of its own origin would not
    hold for it; with a view it shows all of the map from the beginning."""
    floors = view.floors if view is not None else {}
    roots = {"Map": ["map"]} | {f"Floor {floor}": ["floors", floor] for floor in floors}
    maps = [
        blueprint.Spatial2DView(
            name=visible(name),
            origin="/",
            contents=f"{rerun.new_entity_path(root)}/**",
            background=_PAPER,
            visual_bounds=None if view is None else _bounds(view),
        )
        for name, root in roots.items()
    ]
    counts = blueprint.TimeSeriesView(name="Counts", origin="counts")
    lag = blueprint.TimeSeriesView(name="Lag, s", origin="lag")
    changes = blueprint.TextLogView(name="Changes", origin="changes")
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Tabs(*maps, blueprint.GraphView(name="Graph", origin="graph"), active_tab=0),
            blueprint.Vertical(counts, lag, changes),
            column_shares=[2, 1],
        ),
        blueprint.TimePanel(timeline="offset"),
        collapse_panels=True,
    )


def _bounds(view: MapView) -> blueprint.VisualBounds2D | None:
    spots = [(k.pose.x_m, k.pose.y_m) for k in view.keyframes if k.pose is not None]
    spots += [found.spot for found in view.objects.values()]
    if not spots:
        return None
    xs, ys = zip(*spots, strict=True)
    return blueprint.VisualBounds2D(
        x_range=(min(xs) - _MARGIN_M, max(xs) + _MARGIN_M),
        y_range=(-max(ys) - _MARGIN_M, -min(ys) + _MARGIN_M),
    )
