"""Questions of the map over HTTP and Zenoh: `find`, `room`, `path` and one Object, by the query
model of `projections.ask`.

The map is read from the databases whole and kept until their checkpoint moves, so a question of a
map that does not change reads one row. Reading it keeps only one question waiting. Databases have
one map: what changed since another moment is asked of the log (`ServedLog`).
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NotRequired

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import TypedDict  # pydantic needs it before Python 3.12

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from projections.ask.best_views import best_view
from projections.ask.find import FoundObject, SeenAt, Wanted, answer_of, find
from projections.ask.goal_pose import CLEARANCE_M
from projections.ask.kept_crops import KeptCrops
from projections.ask.room_and_path import goal_of, path, room
from projections.ask.what_changed import ChangeKind
from projections.ask.words import Words
from projections.fold.deltas import ObjectOrdinal
from projections.fold.map_errors import LogPointError, ProjectionMismatch, QuestionError
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.localize.relocalize import describe_value
from projections.map.naming import thing_called, things_of
from projections.map.view import MapView
from projections.postgres.queries.live_view import LiveView
from projections.surfaces.text_encoders import words_of

from .states import CURSOR, MAX_PAGE

MapQuestion = Callable[[MapView], dict[str, Any]]
"""A question of a map, which gives the answer as JSON. Raises MisuseError."""
MOST_TEXT: Final = 256
_Text = Annotated[str, Field(min_length=1, max_length=MOST_TEXT)]
_WAIT_S: Final = 0.5
_Flag = Literal["true", "false"]


class NotInMapError(QuestionError):
    """The map does not have what is asked for."""


class LogBusyError(MapfoldError):
    """The log is being read for another question."""


class MapMemory:
    """The map of a database, read again when its checkpoint has moved; for any thread. Of questions
    at one time the first reads it; the others get the map at hand, and wait where there is none."""

    def __init__(self) -> None:
        self._reading = threading.Lock()
        self._kept: tuple[object, LiveView] | None = None

    def view(self, at: object, read: Callable[[], LiveView]) -> LiveView:
        """The map at a checkpoint, or that at hand while it is read. Not to be changed."""
        kept = self._kept
        if kept is not None and kept[0] == at:
            return kept[1]
        if not self._reading.acquire(blocking=kept is None) and kept is not None:
            return kept[1]
        try:
            kept = self._kept
            if kept is None or kept[0] != at:
                self._kept = kept = at, read()
            return kept[1]
        finally:
            self._reading.release()


def asked(question: MapQuestion, view: MapView) -> dict[str, Any]:
    """The answer. Raises NotInMapError."""
    try:
        return question(view)
    except MisuseError as error:
        raise NotInMapError(str(error)) from None


class FindQuery(BaseModel):
    """Parameters of `find`, with the names of the command's options."""

    model_config = ConfigDict(extra="forbid", populate_by_name=False)

    what: _Text | None = Field(
        None, description="A class, words or an Object's id; all if not given."
    )
    room: _Text | None = Field(None, alias="in", description="The Place it is in.")
    near: _Text | None = Field(None, description="X,Y in metres, an Object or a Place.")
    start: _Text | None = Field(None, alias="from", description="Nearest by way from there.")
    missing: _Flag = Field("false", description="Only what is missing.")
    moved: _Flag = Field("false", description="Only what has moved.")
    seen_since: _Text | None = Field(None, description="ISO time: seen then or later.")
    not_seen_since: _Text | None = Field(None, description="ISO time: last seen earlier.")
    every: _Flag = Field("false", alias="all", description="Also what was seen once.")
    at: _Text | None = Field(None, description="A past map: its last event; needs --log.")
    known_at: _Text | None = Field(None, description="Under the corrections known then.")
    limit: Annotated[int, Field(ge=1, le=MAX_PAGE)] = Field(10, description="Most answers.")
    cursor: Annotated[str, Field(pattern=CURSOR)] = Field(
        "0", description="`next` of the page before."
    )

    @classmethod
    def read(cls, options: Mapping[str, str]) -> "FindQuery":
        """Of texts. Raises QuestionError."""
        try:
            return cls.model_validate(dict(options))
        except ValidationError as error:
            first = error.errors()[0]
            name, said = first["loc"][-1], first["msg"].lower()
            raise QuestionError(f"{name} is {describe_value(first['input'])}; {said}") from None

    def question(self, words: Callable[[MapView], Words | None] = words_of) -> MapQuestion:
        """What is asked; ``words`` gives what compares words with the embeddings of a map."""

        def answer(view: MapView) -> dict[str, Any]:
            first, until = int(self.cursor), int(self.cursor) + self.limit
            wanted = Wanted(
                what=self.what,
                room=self.room,
                near=self.near,
                start=self.start,
                missing=self.missing == "true",
                moved=self.moved == "true",
                seen_since=self.seen_since,
                not_seen_since=self.not_seen_since,
                top=until,
                every=self.every == "true",
            )
            document = find(view, wanted, words(view)).document()
            more = {"next": str(until)} if document["count"] > until else {}
            return {**document, "answers": document["answers"][first:], **more}

        return answer


FIND_NAMES: Final = tuple(field.alias or name for name, field in FindQuery.model_fields.items())


class ChangesQuery(BaseModel):
    """Parameters of `changes`, with the names of the command's options."""

    since: _Text | None = Field(
        None, description="A point, day or run from its start; of the last run if not given."
    )
    until: _Text | None = Field(
        None, description="A point, day or run to its end; the map of the databases if not given."
    )
    limit: Annotated[int, Field(ge=1, le=MAX_PAGE)] = Field(100, description="Most changes.")
    cursor: Annotated[str, Field(pattern=CURSOR)] = Field(
        "0", description="`next` of the page before."
    )


class ServedLog:
    """The log beside the databases, for questions of several moments; for any thread. Past maps are
    folded with the settings of the databases' map, and their history is kept beside the log. One
    question is answered at a time: of others that come meanwhile each waits for `_WAIT_S`, and then
    raises LogBusyError, so that they do not keep all workers from questions of the live map."""

    def __init__(self, log: Path, note: Callable[[str], None] = lambda _: None) -> None:
        self._lock, self._settings = threading.Lock(), Settings()
        self._timeline = LogTimeline(log, lambda _: self._settings, note=note, histories=1)
        self._past: tuple[object, MapView] | None = None
        self._crops = KeptCrops(self._timeline.reader)
        self._offsets, self._offsets_until = dict[str, Offset](), FIRST_OFFSET

    def close(self) -> None:
        """Close the log."""
        with self._lock:
            self._timeline.reader.close()

    def refuse_other(self, view: LiveView) -> None:
        """Raise ProjectionMismatch unless the databases' map was made from this log."""
        reader = self._timeline.reader
        if view.log_id != reader.log_id:
            raise ProjectionMismatch(
                f"--log {reader.path} is log {reader.log_id}, but the databases were made from"
                f" {view.log_id}; give that log, or run `{advised('replay', reader.path)}`"
            )

    def crop(self, served: LiveView, name: str) -> bytes:
        """The JPEG of a detection, by its det_id, or of an Object's best view, by its id. Raises
        NotInMapError."""
        with self._reading(served):
            found = self._crops.jpeg(name, self._offset_of(name))
            if found is None and name.startswith("obj-"):
                end = served.next_offset
                found = self._best_view(self._past_map(end, end), name)
        if found is None:
            raise NotInMapError(f"the log keeps no crop of {describe_value(name)}")
        return found

    def find(self, served: LiveView, query: FindQuery) -> dict[str, Any]:
        """`find` in a past map. Raises NotInMapError."""
        with self._reading(served):
            end = served.next_offset
            if query.at is not None:
                end = self._timeline.moment(query.at, is_end=True)
            known_at = end
            if query.known_at is not None:
                known_at = self._timeline.moment(query.known_at, is_end=True)
            return query.question()(self._past_map(end, known_at))

    def changes(self, served: LiveView, asked: ChangesQuery) -> dict[str, Any]:
        """A page of what changed. Raises NotInMapError."""
        with self._reading(served):
            end, start = served.next_offset, None
            if asked.until is not None:
                end = self._timeline.moment(asked.until, is_end=True)
            if asked.since is not None:
                start = self._timeline.moment(asked.since, is_end=False)
            found = self._timeline.changes(start, end)
        first, until = int(asked.cursor), int(asked.cursor) + asked.limit
        more = {"next": str(until)} if len(found.changes) > until else {}
        document = found.document()
        return {**document, "changes": document["changes"][first:until], **more}

    def _past_map(self, end: Offset, known_at: Offset) -> MapView:
        """The last one asked is kept, with what it knows of its things."""
        at = end, known_at, self._settings
        if self._past is None or self._past[0] != at:
            self._past = at, self._timeline.at(end, known_at=known_at)
        return self._past[1]

    @contextlib.contextmanager
    def _reading(self, served: LiveView) -> Iterator[None]:
        """Read the log for one question. Raises LogBusyError, ProjectionMismatch, and NotInMapError
        for what the log does not have."""
        if not self._lock.acquire(timeout=_WAIT_S):
            raise LogBusyError("the log is read for another question; ask again in a second")
        try:
            self.refuse_other(served)
            self._settings = served.settings
            self._timeline.refresh()
            yield
        except (MisuseError, LogPointError) as error:
            raise NotInMapError(str(error)) from None
        finally:
            self._lock.release()

    def _offset_of(self, det_id: str) -> Offset | None:
        """The offset of a detection by the kept history, so that no index of crops is needed. Of
        each event the ids are read once."""
        tables = self._timeline.history.tables
        first, count = (
            tables.before("observation", end) for end in (self._offsets_until, tables.end)
        )
        if first < count:
            names = tables.texts("observation", "det_id", first, count)
            numbers = tables.integers("observation", "offset", count)[first:].tolist()
            for name, offset in zip(names, numbers, strict=True):
                self._offsets.setdefault(name or "", Offset(offset))
        self._offsets_until = max(self._offsets_until, tables.end)
        return self._offsets.get(det_id)

    def _best_view(self, view: MapView, object_id: str) -> bytes | None:
        meant = thing_called(object_id, things_of(view), ["object"])
        found = view.object_survivors.find(ObjectOrdinal(meant.ordinal))
        best = best_view(view, view.all_objects[found], self._crops)
        return None if best is None else best.jpeg


NO_LOG_OF_CROPS: Final = "the databases keep no crops; start the service with --log LOG"
NO_LOG_OF_THE_PAST: Final = (
    "the databases have one map, and only the log knows past ones; start the service with --log LOG"
)
NO_LOG: Final = (
    "the databases have one map, and only the log knows what changed since another; start the"
    " service with --log LOG"
)


def room_question(name: str) -> MapQuestion:
    """What a Place is and holds."""
    return lambda view: room(view, name).document()


def path_question(start: str, end: str, clearance: float = CLEARANCE_M) -> MapQuestion:
    """The way from one thing to another."""
    return lambda view: path(view, start, end, clearance).document()


def goal_question(name: str, clearance: float = CLEARANCE_M) -> MapQuestion:
    """The pose from which to see an Object."""

    def answer(view: MapView) -> dict[str, Any]:
        meant = thing_called(name, things_of(view), ["object"])
        return goal_of(view, meant.id, clearance).document()

    return answer


def object_question(name: str) -> MapQuestion:
    """One Object, with the events that saw it."""

    def answer(view: MapView) -> dict[str, Any]:
        meant = thing_called(name, things_of(view), ["object"])
        found = view.object_survivors.find(ObjectOrdinal(meant.ordinal))
        return answer_of(view, view.all_objects[found], "id").document()

    return answer


_Place = Annotated[str | None, Field(description="Where it is, or, missing, was.")]
_Spot = Annotated[tuple[float, float] | None, Field(description="Metres in the map's frame.")]
ChangeShape = TypedDict(
    "ChangeShape",
    {
        "kind": ChangeKind,
        "object_id": str,
        "class_name": str,
        "place_id": _Place,
        "place_name": _Place,
        "place_type": _Place,
        "from": _Spot,
        "to": _Spot,
        "moved_m": float | None,
        "error_m": float | None,
        "obs_count": int,
        "seen": SeenAt,
        "sentence": str,
    },
)
"""What became of an Object."""


class ChangesPageShape(TypedDict):
    """What changed for sure between the maps after ``since`` and ``until`` events, the largest
    first; ``next`` is there when more come."""

    since: Annotated[int, Field(ge=0)]
    until: Annotated[int, Field(ge=0)]
    counts: dict[ChangeKind, int]
    unsure: Annotated[int, Field(ge=0, description="Changes that are not sure.")]
    changes: list[ChangeShape]
    next: NotRequired[Annotated[str, Field(description="The cursor of the next page.")]]


class FoundPageShape(TypedDict):
    """Objects that answer a question, best first; ``next`` is there when more come."""

    match: str
    classes: list[str]
    count: Annotated[int, Field(ge=0)]
    unconfirmed: Annotated[int, Field(ge=0)]
    answers: list[FoundObject]
    text_encoder: Annotated[str | None, Field(description="The model that compared the words.")]
    remark: Annotated[str | None, Field(description="Why none compared them, if that matters.")]
    next: NotRequired[Annotated[str, Field(description="The cursor of the next page.")]]


for _shape in (ChangeShape, ChangesPageShape, FoundPageShape):
    _shape.__name__ = _shape.__qualname__ = _shape.__name__.removesuffix("Shape")
