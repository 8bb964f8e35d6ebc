"""How a map came about, for Foxglove: an MCAP file; and a server whose time is set by Foxglove's
timeline: seek, play and pause show the map as it was. And a layout for its panels.

The SDK calls the ``on_`` methods in its own thread; they only store the request. The thread that
runs `Playback.run` folds and publishes.
"""

import io
import logging
import math
import os
import re
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

from foxglove import Capability, Context, layouts, open_mcap, start_server
from foxglove.websocket import (
    ChannelView,
    Client,
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    ServerListener,
    WebSocketServer,
)

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.machine import gc_paused
from eventsrc.base.user_files import OutputFile, written_whole
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.deltas import KeyframeAdded, MapGiven, PlacesMerged
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import Moments, RecordedFold, fold_events, new_map
from projections.map.parsing import READ_AHEAD
from projections.map.phrases import change_lines
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_recorder import map_at
from projections.store.stored_view import StoredView
from projections.store.tables import Tables, TableWriter

from .topics import FRAME, MapTopics

_SERIES: Final = (("places", "#3b82c4"), ("objects", "#e08a1e"), ("noise", "#8b939c"))


def layout_json() -> str:
    """The layout as JSON, for "Import from file" in Foxglove's menu of layouts."""
    seen_from_above = layouts.ThreeDeeConfig(
        fixed_frame=FRAME,
        follow_mode="follow-none",
        camera_state=layouts.ThreeDeeCameraState(perspective=False, phi=0.0, distance=25.0),
        topics={
            "/mapfold/map": layouts.BaseRendererSceneUpdateTopicSettings(visible=True),
            "/mapfold/walls": layouts.BaseRendererGridTopicSettings(visible=True),
        },
    )
    counts = layouts.PlotConfig(
        paths=[
            layouts.PlotSeries(
                value=f"/mapfold/state.{name}",
                label=name,
                color=colour,
                enabled=True,
                line_interpolation="step",
            )
            for name, colour in _SERIES
        ],
        show_legend=True,
    )
    changes = layouts.LogConfig(topic_to_render="/mapfold/changes")
    beside = layouts.SplitContainer(
        direction="column",
        items=[
            layouts.SplitItem(content=layouts.PlotPanel(config=counts, title="Counts")),
            layouts.SplitItem(content=layouts.LogPanel(config=changes, title="Changes")),
        ],
    )
    whole = layouts.SplitContainer(
        direction="row",
        items=[
            layouts.SplitItem(
                proportion=2, content=layouts.ThreeDeePanel(config=seen_from_above, title="Map")
            ),
            layouts.SplitItem(proportion=1, content=beside),
        ],
    )
    return layouts.Layout(content=whole).to_json() + "\n"


PROTOCOL: Final = "foxglove.sdk.v1"
"""The WebSocket subprotocol that a client must offer. The SDK answers others, such as the
``foxglove.websocket.v1`` of older clients, with status 400 before any method here is called."""
_MOST_TROUBLES: Final = 50
_CLIENT: Final = re.compile(r"(client |from )(\S+):[0-9]+")


class ClientTroubles(logging.Handler):
    """Passes to ``note`` what the SDK logs of clients that it refuses or does not understand.

    The same trouble with the same address is said once, and no more than 50: clients try again
    every few seconds, and choose the text. ``unsaid`` counts the others. A context manager.
    """

    def __init__(self, note: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self.unsaid = 0
        self._note, self._said = note, set[str]()
        self._logger = logging.getLogger("foxglove")

    def emit(self, record: logging.LogRecord) -> None:
        """Say it, if it is a new trouble."""
        text = _CLIENT.sub(r"\1\2", record.getMessage())
        if text in self._said or len(self._said) == _MOST_TROUBLES:
            self.unsaid += 1
            return
        self._said.add(text)
        if "handshake failed" in text:
            text += (
                f"; if it is Foxglove or Lichtblick, update it: clients must speak {PROTOCOL}, and"
                " older ones speak foxglove.websocket.v1 only"
            )
        self._note(text)

    def __enter__(self) -> Self:
        self._propagated, self._logger.propagate = self._logger.propagate, False
        self._logger.addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._logger.removeHandler(self)
        self._logger.propagate = self._propagated


TICK_S: Final = 0.05
"""Seconds between two maps that are shown while playing."""
ANSWERED_S: Final = 0.02
"""Delay of messages after a seek, seconds. The SDK sends its answer after the call that makes it
and does not report when; a client clears its display at that answer."""


class PastMaps:
    """Every past map of a log's first ``end`` events under ``corrections``, from one fold, which
    raises FoldError at an event that cannot be folded. ``floors`` are those that the log's
    occupancy maps name."""

    def __init__(
        self,
        reader: LogReader,
        settings: Settings,
        corrections: Corrections,
        end: Offset,
        progress: Callable[[int, int], None] = lambda *_: None,
    ) -> None:
        self.reader = reader
        self.moments = Moments(reader.read(FIRST_OFFSET, end))
        self._lines: list[tuple[Offset, str]] = []
        self._merges: list[PlacesMerged] = []
        writer = TableWriter(Tables())
        view = MapView(settings, keep_embeddings=False, corrections=corrections)
        semantic_map = new_map(reader, settings, corrections)
        events = reader.read(FIRST_OFFSET, end)
        with gc_paused():
            for offset, deltas in fold_events(events, semantic_map, ahead=READ_AHEAD):
                view.apply_event(offset, deltas)
                writer.add(offset, deltas)
                self._lines += ((offset, line) for line in change_lines(view, deltas))
                self._merges += (delta for delta in deltas if isinstance(delta, PlacesMerged))
                progress(offset, end)
        self.floors = list(view.maps)
        tables = Tables(writer.finish())
        self._history = History(settings, corrections, tables, partial(map_at, reader))

    def lines_between(self, start: Offset, end: Offset) -> list[tuple[Offset, str]]:
        """The changes of the events from ``start`` to before ``end``: offset and line of each."""
        first, last = (
            bisect_left(self._lines, at, key=lambda each: each[0]) for at in (start, end)
        )
        return self._lines[first:last]

    def at(self, end: Offset) -> tuple[MapView, list[PlacesMerged]]:
        """The map after ``end`` events, and its merges of places."""
        merges = self._merges[: bisect_left(self._merges, end, key=lambda merge: merge.offset)]
        with gc_paused():
            return StoredView(self._history, end), merges


class Playback(ServerListener):
    """A server of past maps, which listens from its construction until `run` has ended.

    Objects that are not confirmed are shown only with ``everything``. Raises OSError where it
    cannot listen. At first it shows the end of the log, paused.
    """

    def __init__(
        self, maps: PastMaps, name: str, host: str, port: int, *, everything: bool = False
    ) -> None:
        self._maps = maps
        self._first_ns, self._last_ns = maps.moments.span_ns
        self._changed = threading.Condition()
        # The fields below are shared with the SDK's thread, under _changed.
        self._now_ns, self._shown = self._last_ns, Offset(len(maps.moments.times_ns))
        self._playing, self._speed = False, 1.0
        self._to_show, self._ended = False, False
        context = Context()
        self._topics = MapTopics(context, everything=everything)
        self._topics.declare(maps.moments.topics, maps.floors)
        try:
            self.server: WebSocketServer = start_server(
                name=name,
                host=host,
                port=port,
                capabilities=[Capability.PlaybackControl, Capability.Time],
                server_listener=self,
                playback_time_range=(self._first_ns, self._last_ns),
                context=context,
            )
        except RuntimeError as error:
            raise OSError(str(error)) from error

    def end(self) -> None:
        """End `run`, and with it the server."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def on_playback_control_request(
        self, playback_control_request: PlaybackControlRequest
    ) -> PlaybackState | None:
        """Apply a client's request; the SDK answers with the returned state."""
        asked = playback_control_request
        with self._changed:
            self._playing = asked.playback_command is PlaybackCommand.Play
            self._speed = asked.playback_speed if 0 < asked.playback_speed < math.inf else 1.0
            if asked.seek_time is not None:
                self._now_ns = min(max(asked.seek_time, self._first_ns), self._last_ns)
                self._shown = self._maps.moments.offset_at(self._now_ns)
                self._to_show = True
            if self._now_ns >= self._last_ns:
                self._playing = False
            self._changed.notify()
            return self._state(asked.request_id, did_seek=asked.seek_time is not None)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        """Publish the current map to a client that subscribes to a topic."""
        with self._changed:
            self._to_show = True
            self._changed.notify()

    def run(self) -> None:
        """Publish what clients request, and advance the time, until `end`; then stop the server."""
        try:
            self._run()
        finally:
            self.server.stop()  # here: the SDK's server must not be used by two threads at once

    def _run(self) -> None:
        before = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ended or self._to_show, TICK_S if self._playing else None
                )
                if self._to_show:
                    self._changed.wait_for(lambda: self._ended, ANSWERED_S)
                if self._ended:
                    return
                to_show = self._to_show
            if to_show:
                self._show()
            now = time.monotonic()
            self._pass(now - before)
            before = now

    def _state(self, request_id: str = "", *, did_seek: bool = False) -> PlaybackState:
        if self._playing:
            status = PlaybackStatus.Playing
        else:
            at_end = self._now_ns >= self._last_ns
            status = PlaybackStatus.Ended if at_end else PlaybackStatus.Paused
        return PlaybackState(status, self._now_ns, self._speed, did_seek, request_id)

    def _show(self) -> None:
        """Publish the whole map, for clients that have nothing yet."""
        with self._changed:
            self._to_show, now, shown = False, self._now_ns, self._shown
        view, merges = self._maps.at(shown)
        self.server.broadcast_time(now)
        for given in view.maps.values():
            self._topics.walls(view, given, now)
        self._topics.robot(view, now)
        self._topics.scene(view, merges, now, digest=map_digest(view))

    def _pass(self, seconds: float) -> None:
        """Advance the time while playing, and publish what changed."""
        with self._changed:
            if not self._playing or self._to_show:
                return
            self._now_ns = min(self._now_ns + int(seconds * self._speed * 1e9), self._last_ns)
            before, self._shown = self._shown, self._maps.moments.offset_at(self._now_ns)
            now, shown = self._now_ns, self._shown
            ended = now >= self._last_ns
            self._playing = not ended
        self.server.broadcast_time(now)
        if shown > before:
            self._publish(before, shown, now)
        if ended:
            with self._changed:
                state = self._state()
            self.server.broadcast_playback_state(state)

    def _publish(self, start: Offset, end: Offset, now: int) -> None:
        view, merges = self._maps.at(end)
        times = self._maps.moments.times_ns
        for event in self._maps.reader.read(start, end):
            self._topics.event(event, times[event.offset])
        for offset, line in self._maps.lines_between(start, end):
            self._topics.changes([line], times[offset])
        for given in view.maps.values():
            if given.offset >= start:
                self._topics.walls(view, given, now)
        self._topics.robot(view, now)
        self._topics.scene(view, merges, now)


def write_recording(fold: RecordedFold, path: Path, *, everything: bool = False) -> int:
    """Record a fold's events and the maps that they make; returns the number of scenes.

    Scenes have Objects that are not confirmed only with ``everything``. The same log gives the same
    bytes. Raises FoldError at an event that cannot be folded, and what `written_whole` raises.
    """
    context, scenes = Context(), 0
    with written_whole(path) as file:
        if not file.seekable():
            raise MisuseError(f"{path}: an MCAP recording goes to a file, not a pipe; choose one")
        sink = _Sink(file)
        with open_mcap(sink, context=context):
            topics = MapTopics(context, everything=everything)
            for event, now, deltas, is_scene in fold:
                topics.event(event, now)
                topics.changes(change_lines(fold.view, deltas), now)
                for delta in deltas:
                    if isinstance(delta, MapGiven):
                        topics.walls(fold.view, delta, now)
                if any(isinstance(delta, KeyframeAdded) for delta in deltas):
                    topics.robot(fold.view, now)
                if is_scene:
                    topics.scene(fold.view, fold.merges, now)
                    scenes += 1
                sink.check()
        sink.check()
    return scenes


class _Sink(io.RawIOBase):
    """What the SDK writes to. It would print a line for each message after a failed write, so the
    error is kept for `check`, and what comes after it is dropped."""

    def __init__(self, file: OutputFile) -> None:
        self._file = file
        self._position = 0
        self._failed: Exception | None = None

    def write(self, data: Any, /) -> int:
        try:
            if self._failed is None:
                self._file.write(data)
        except (MapfoldError, OSError) as error:
            self._failed = error
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        self._position = offset + (self._position if whence == os.SEEK_CUR else 0)
        if self._failed is None:
            self._position = self._file.seek(offset, whence)
        return self._position

    def check(self) -> None:
        """Raise the error of the first write that failed, if one did."""
        if self._failed is not None:
            raise self._failed
