"""Questions of the map over HTTP and Zenoh: `find`, `room`, `path` and one Object, by the query
model of `projections.ask`.

The map is read from the databases whole and kept until their checkpoint moves, so a question of a
map that does not change reads one row.
"""

import threading
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal, NotRequired

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import TypedDict  # pydantic needs it before Python 3.12

from eventsrc.base.errors import MisuseError
from projections.ask.driven_ground import CLEARANCE_M
from projections.ask.find import FoundObject, Wanted, answer_of, find, robot_seconds
from projections.ask.room_and_path import path, room
from projections.fold.deltas import ObjectOrdinal
from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import describe_value
from projections.map.naming import thing_called, things_of
from projections.map.view import MapView
from projections.postgres import checkpoints
from projections.postgres.connection import Connection
from projections.postgres.queries.live_view import read_view

from .states import CURSOR, MAX_PAGE

MapQuestion = Callable[[MapView], dict[str, Any]]
"""A question of a map, which gives the answer as JSON. Raises MisuseError."""
MOST_TEXT: Final = 256
_Text = Annotated[str, Field(min_length=1, max_length=MOST_TEXT)]
_Flag = Literal["true", "false"]


class NotInMapError(QuestionError):
    """The map does not have what is asked for."""


class MapMemory:
    """The map of a database, read again when its checkpoint has moved; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: tuple[object, MapView] | None = None

    def view(self, connection: Connection) -> MapView:
        """The map; ``connection`` was set up by `prepare_graph`. Not to be changed."""
        at = checkpoints.load(connection, "graph")
        with self._lock:
            if self._kept is None or self._kept[0] != at:
                self._kept = at, read_view(connection)
            return self._kept[1]


def asked(question: MapQuestion, view: MapView) -> dict[str, Any]:
    """The answer. Raises NotInMapError."""
    try:
        return question(view)
    except MisuseError as error:
        raise NotInMapError(str(error)) from None


class FindQuery(BaseModel):
    """Parameters of `find`, with the names of the command's options."""

    model_config = ConfigDict(extra="forbid", populate_by_name=False)

    what: _Text | None = Field(None, description="A class or an Object's id; all if not given.")
    room: _Text | None = Field(None, alias="in", description="The Place it is in.")
    near: _Text | None = Field(None, description="X,Y in metres, an Object or a Place.")
    start: _Text | None = Field(None, alias="from", description="Nearest by way from there.")
    missing: _Flag = Field("false", description="Only what is missing.")
    moved: _Flag = Field("false", description="Only what has moved.")
    seen_since: _Text | None = Field(None, description="ISO time: seen then or later.")
    not_seen_since: _Text | None = Field(None, description="ISO time: last seen earlier.")
    every: _Flag = Field("false", alias="all", description="Also what was seen once.")
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

    def question(self) -> MapQuestion:
        """What is asked."""

        def answer(view: MapView) -> dict[str, Any]:
            first, until = int(self.cursor), int(self.cursor) + self.limit
            wanted = Wanted(
                what=self.what,
                room=self.room,
                near=self.near,
                start=self.start,
                missing=self.missing == "true",
                moved=self.moved == "true",
                seen_since=_seconds(self.seen_since),
                not_seen_since=_seconds(self.not_seen_since),
                top=until,
                every=self.every == "true",
            )
            document = find(view, wanted).document()
            more = {"next": str(until)} if document["count"] > until else {}
            return {**document, "answers": document["answers"][first:], **more}

        return answer


FIND_NAMES: Final = tuple(field.alias or name for name, field in FindQuery.model_fields.items())


def room_question(name: str) -> MapQuestion:
    """What a Place is and holds."""
    return lambda view: room(view, name).document()


def path_question(start: str, end: str, clearance: float = CLEARANCE_M) -> MapQuestion:
    """The way from one thing to another."""
    return lambda view: path(view, start, end, clearance).document()


def object_question(name: str) -> MapQuestion:
    """One Object, with the events that saw it."""

    def answer(view: MapView) -> dict[str, Any]:
        meant = thing_called(name, things_of(view), ["object"])
        found = view.object_survivors.find(ObjectOrdinal(meant.ordinal))
        return answer_of(view, view.all_objects[found], "id").document()

    return answer


def _seconds(time: str | None) -> float | None:
    return None if time is None else robot_seconds(time)


class FoundPageShape(TypedDict):
    """Objects that answer a question, best first; ``next`` is there when more come."""

    match: str
    classes: list[str]
    count: Annotated[int, Field(ge=0)]
    unconfirmed: Annotated[int, Field(ge=0)]
    answers: list[FoundObject]
    next: NotRequired[Annotated[str, Field(description="The cursor of the next page.")]]


FoundPageShape.__name__ = FoundPageShape.__qualname__ = "FoundPage"
