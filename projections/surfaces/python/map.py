"""From a folder of MCAP segments to a `Map`, and `relocalize`, which asks it."""

import html
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from projections.ask.best_views import best_views
from projections.ask.find import FoundObjects, Wanted, find
from projections.ask.goal_pose import CLEARANCE_M, GoalPose
from projections.ask.kept_crops import KeptCrops
from projections.ask.room_and_path import DrivenPath, Room, goal_of, path, room
from projections.ask.what_changed import MapChanges, map_changes
from projections.fold.corrections import Corrections
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.map_errors import SettingsError
from projections.fold.settings import CameraConstants, Settings, preset_assignments, read_settings
from projections.history import LogTimeline
from projections.localize.relocalize import (
    Answer,
    ExactIndex,
    Method,
    Question,
    parse_question,
    rank,
    read_question,
)
from projections.localize.relocalize.reading import MAX_QUESTION_BYTES
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.naming import thing_called, things_of
from projections.map.parsing import read_corrections
from projections.map.state_output import state_document, state_text
from projections.map.view import MapView
from projections.surfaces.text_encoders import words_of

from .known_things import KnownObject, KnownPlace, KnownThings

_MOST_ROWS = 50
_HTML_BYTES, _TABLE_BYTES = 60_000, 15_000
"""A notebook keeps what it shows: at most so many bytes of a map, and of its table."""


class Map:
    """The map after some events of a log. In a notebook it is shown as a picture and a table.

    ``view`` is the map as data (`projections.map.view.MapView`), not to be changed.

    Examples:
        >>> house = fold("logs/sample")
        >>> house.places[3]["type"], house.digest[:8]
        ('living room', '18fce70e')
    """

    def __init__(
        self, view: MapView, known_at: Offset | None = None, log: Path | None = None
    ) -> None:
        self.view = view
        self._known_at, self._log = known_at, log

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the whole map, in hex; the same log and settings give the same one."""
        return map_digest(self.view)

    @cached_property
    def index(self) -> ExactIndex:
        """The map's vectors, laid out for `relocalize`."""
        return ExactIndex(self.view)

    @cached_property
    def state(self) -> dict[str, Any]:
        """The document that ``mapfold state --json`` prints."""
        return state_document(self.view, self.digest, self._known_at)

    @property
    def places(self) -> KnownThings[KnownPlace]:
        """The Places, in the order in which they were founded."""
        return KnownThings.of(KnownPlace, self.state["places"])

    @property
    def objects(self) -> KnownThings[KnownObject]:
        """The Objects, in the order in which they were found; ``to_pandas()`` makes a table."""
        return KnownThings.of(KnownObject, self.state["objects"])

    def graph(self) -> Any:
        """A `networkx.Graph` of Places and Objects, as GraphML has it: ``kind``, ``label``, ``x``
        and ``y`` of nodes, and ``label`` of edges, ADJACENT_TO or LOCATED_IN."""
        from projections.adapters.export.graphs import graph_of  # networkx takes long to import

        return graph_of(self.view)

    @property
    def adjacency(self) -> list[dict[str, Any]]:
        """Pairs of neighbouring Places, each with its number of transitions."""
        return list(self.state["adjacency"])

    def place(self, text: str) -> KnownPlace:
        """The Place that ``text`` names: an id, a given name, ``p3``, or a type of room that only
        one has. Raises NoSuchThing with the nearest names, and SeveralThings.
        """
        wanted = thing_called(text, things_of(self.view), ("place",))
        id_ = self.view.place_id(self.view.survivors.find(PlaceOrdinal(wanted.ordinal)))
        return next(each for each in self.places if each["place_id"] == id_)

    def object(self, text: str) -> KnownObject:
        """The Object that ``text`` names: an id, its first six characters or more, or a class that
        only one has. Raises NoSuchThing with the nearest names, and SeveralThings."""
        wanted = ObjectOrdinal(thing_called(text, things_of(self.view), ("object",)).ordinal)
        id_ = self.view.all_objects[self.view.object_survivors.find(wanted)].object_id
        return next(each for each in self.objects if each["object_id"] == id_)

    def find(
        self,
        what: str | None = None,
        *,
        room: str | None = None,
        near: str | tuple[float, float] | None = None,
        start: str | tuple[float, float] | None = None,
        missing: bool = False,
        moved: bool = False,
        seen_since: float | str | None = None,
        not_seen_since: float | str | None = None,
        top: int = 10,
        every: bool = False,
    ) -> FoundObjects:
        """The Objects that are ``what``, such as ``"chairs"`` or an id, best first; None for all.
        The text encoder of the settings compares words such as ``"red mug"`` with embeddings.

        ``room`` is the Place they are in, ``near`` the point in metres or the thing from which they
        are ordered, ``start`` that from which the way over driven ground counts. Times are ISO 8601
        or robot seconds. Objects that were seen once are left out without ``every``. Raises
        MisuseError for what this map does not have.

        Examples:
            >>> house = fold("logs/sample", preset="full")
            >>> [answer.class_name for answer in house.find("sinks", top=1).answers]
            ['sink']
        """
        return find(
            self.view,
            Wanted(
                what=what,
                room=room,
                near=None if near is None else _text(near),
                start=None if start is None else _text(start),
                missing=missing,
                moved=moved,
                seen_since=seen_since,
                not_seen_since=not_seen_since,
                top=top,
                every=every,
            ),
            words_of(self.view),
        )

    def room(self, name: str) -> Room:
        """What the Place that ``name`` names is, what is in it, its neighbours and visits. Raises
        NoSuchThing and SeveralThings.

        Examples:
            >>> fold("logs/sample").room("kitchen").objects[0].class_name
            'oven'
        """
        return room(self.view, name)

    def crops(self, thing: str) -> list[bytes]:
        """The JPEGs that the log keeps of an Object, by any of its names, best view first: whole in
        the picture, then large and sure. Raises NoSuchThing and SeveralThings, LogNotFound."""
        wanted = ObjectOrdinal(thing_called(thing, things_of(self.view), ("object",)).ordinal)
        found = self.view.all_objects[self.view.object_survivors.find(wanted)]
        if self._log is None:
            raise MisuseError("this map was not folded from a log by itself; use fold(LOG)")
        with LogReader(self._log) as reader:
            return [each.jpeg for each in best_views(self.view, found, KeptCrops(reader))]

    def path(
        self,
        start: str | tuple[float, float],
        end: str | tuple[float, float],
        *,
        clearance_m: float = CLEARANCE_M,
    ) -> DrivenPath:
        """The way over driven ground between two points, Objects or Places; to an Object it ends at
        its `goal`. Raises MisuseError, also NoSuchThing and SeveralThings.

        Examples:
            >>> way = fold("logs/sample").path("kitchen", "bathroom")
            >>> round(way.length_m, 1), [place.type for place in way.places]
            (6.1, ['kitchen', None, 'bathroom'])
        """
        return path(self.view, _text(start), _text(end), clearance_m)

    def goal(self, thing: str, *, clearance_m: float = CLEARANCE_M) -> GoalPose:
        """The pose from which a robot sees an Object, so far from walls. Raises MisuseError where
        there is none, also NoSuchThing and SeveralThings."""
        return goal_of(self.view, thing, clearance_m)

    def changes(self, since: "Map | int | str | None" = None) -> MapChanges:
        """What changed for sure since an earlier map of the same log, or a day, a run or another
        moment of it, by default since the last run began; for these the log is folded again, by
        `Timeline.changes` only once. Raises MisuseError for a map without evidence."""
        if isinstance(since, Map):
            return map_changes(since.view, self.view)
        if self._log is None:
            raise MisuseError("this map was not folded from a log; give an earlier map as since")
        with LogTimeline(self._log, self.view.settings, cache=False) as timeline:
            start = None if since is None else timeline.moment(str(since), is_end=False)
            return timeline.changes(start, self.view.next_offset, known_at=self._known_at)

    def draw(self, out: str | Path, title: str = "") -> None:
        """Draw the map to a file .png, .svg or .pdf. Raises MisuseError if it cannot be written."""
        from projections.adapters.drawing import draw_map

        draw_map(self.view, Path(out), title=title or self._title)

    @property
    def _title(self) -> str:
        return f"map {self.digest[:8]} after {self.view.next_offset:,} events"

    def __str__(self) -> str:
        return state_text(self.view, self.digest, self._known_at)

    def __repr__(self) -> str:
        counts = self.view.counts()
        places, objects = counted(counts["places"], "place"), counted(counts["objects"], "object")
        events = counted(self.view.next_offset, "event")
        return f"<Map after {events}: {places}, {objects}, digest {self.digest[:16]}>"

    def _repr_html_(self) -> str:
        from projections.adapters.drawing import map_png  # see `draw`

        names = ("place_id", "name", "type", "keyframe_count", "centroid_x", "centroid_y")
        head = "".join(f"<th>{name}</th>" for name in names)
        rows = [
            f"<tr>{''.join(f'<td>{_cell(place.get(name))}</td>' for name in names)}</tr>"
            for place in self.places[:_MOST_ROWS]
        ]
        while sum(len(row.encode()) for row in rows) > _TABLE_BYTES:
            rows.pop()
        more = len(self.places) - len(rows)
        rest = f"<p>and {more} more places</p>" if more > 0 else ""
        table = f"<table><tr>{head}</tr>{''.join(rows)}</table>{rest}"
        left = _HTML_BYTES - 500 - len(table.encode())
        picture = map_png(self.view, self._title, most_bytes=left * 3 // 4)
        if picture is None:
            return f"<p>{html.escape(repr(self))}</p>{table}"
        source = b64encode(picture).decode("ascii")
        alt = html.escape(repr(self))
        return (
            f'<img alt="{alt}" style="max-width:100%" src="data:image/png;base64,{source}">{table}'
        )


def _text(spot: str | tuple[float, float]) -> str:
    return spot if isinstance(spot, str) else f"{spot[0]},{spot[1]}"


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if isinstance(value, float) else html.escape(visible(str(value)))


QuestionLike: TypeAlias = Question | Mapping[str, Any] | Sequence[Mapping[str, Any]] | str | Path


def relocalize(
    house: Map,
    question: QuestionLike,
    *,
    top: int = 3,
    method: Method = "joint",
    camera: CameraConstants | None = None,
) -> Answer:
    """The likeliest Places and the pose of a robot that sees some crops.

    ``question`` is an envelope, a list of crops, a document of views (docs/relocalization.md), or
    the path of a file of these. ``top`` Places are listed. The search is exact; the map's vectors
    are laid out at its first question. Raises QuestionError for a question that cannot be read, of
    another embedding space, or of a class that the map does not have, MisuseError for a map folded
    without embeddings.

    Examples:
        >>> house = fold("logs/sample")
        >>> answer = relocalize(house, [{"class": "toilet"}, {"class": "mirror"}])
        >>> [place.place_id for place in answer.places]
        ['sim-7-a_p0', 'sim-7-a_p7', 'sim-7-a_p5']
    """
    if not house.view.keep_embeddings:
        raise MisuseError("this map was folded with embeddings=False; fold it with them to ask it")
    asked = _read(question)
    return rank(asked, house.index.search(asked.crops), top=top, method=method, camera=camera)


def _read(question: QuestionLike) -> Question:
    if isinstance(question, Question):
        return question
    if not isinstance(question, str | Path):
        return read_question(question)
    try:
        return parse_question(read_file(Path(question), MAX_QUESTION_BYTES))
    except FileFault as fault:
        raise MisuseError(f"question {question}: {fault}; give a file of JSON") from None


LogLike: TypeAlias = str | Path | LogReader
SettingsLike: TypeAlias = Settings | Mapping[str, Any] | str | Path | None


def open_log(path: str | Path) -> LogReader:
    """Open a log for reading; a context manager.

    Its events come from ``read(start, end)``, their number is ``next_offset``. A log that is being
    recorded may be opened; ``refresh()`` finds what was recorded since. Raises LogNotFound,
    NotALog or LogDamaged.

    Examples:
        >>> with open_log("logs/sample") as log:
        ...     log.next_offset, next(log.read()).key
        (447, 'mapfold/command')
    """
    return LogReader(Path(path))


def fold(
    log: LogLike,
    *,
    at: int | str = "end",
    settings: SettingsLike = None,
    preset: str | None = None,
    known_at: int | str | None = None,
    embeddings: bool = True,
) -> Map:
    """Fold a log into its map.

    ``at`` is the point up to which it is folded: a number of events, a time in ISO 8601,
    ``RUN:KEYFRAME`` or ``end``. ``settings`` are `Settings`, a mapping of their names as in
    ``--settings``, or a file of these; by default those that the log names. ``preset`` changes
    them: ``classic``, ``rooms`` or ``full``. Commands recorded before ``known_at``, by default
    ``at``, are obeyed. Without ``embeddings`` the map takes less memory and cannot be asked by
    `relocalize`.

    Raises LogNotFound, NotALog or LogDamaged for the log, MisuseError for a point that it does not
    have, SettingsError for settings, FoldError for an event that cannot be folded.

    Examples:
        >>> fold("logs/sample", at=240)
        <Map after 240 events: 6 places, 47 objects, digest b779fc66310ee528>
    """
    with nullcontext(log) if isinstance(log, LogReader) else open_log(log) as reader:
        end = resolve(reader, str(at))
        known = end if known_at is None else resolve(reader, str(known_at))
        corrections = read_corrections(reader, known)
        chosen = settings_from(settings, preset)(corrections)
        view = fold_log(reader, chosen, end, keep_embeddings=embeddings, corrections=corrections)[1]
    return Map(view, known, reader.path)


def settings_from(
    settings: SettingsLike, preset: str | None = None
) -> Callable[[Corrections], Settings]:
    """The settings under some corrections: those given, else those that the log names, changed by
    a preset. Raises SettingsError."""
    assignments = () if preset is None else preset_assignments(preset)
    if settings is None:
        return lambda known: (known.settings or Settings()).with_assignments(assignments)
    given = settings if isinstance(settings, Settings) else _parse(settings)
    chosen = given.with_assignments(assignments)
    return lambda _: chosen


def _parse(settings: Mapping[str, Any] | str | Path) -> Settings:
    if isinstance(settings, Mapping):
        return Settings.from_document(dict(settings))
    try:
        return read_settings(Path(settings))
    except FileFault as fault:
        raise MisuseError(f"settings {settings}: {fault}; give a file of JSON") from None
    except SettingsError as error:
        raise SettingsError(f"settings {settings}: {error}") from None
