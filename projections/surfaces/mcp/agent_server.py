"""The tools and resources of the server, thin over `projections.ask`: an answer is the JSON that
the command of the same name prints, with what names the map and the events that it rests on.

Calls are answered one after another. An error is a text for the agent: what is wrong, what to ask.
"""

import functools
import threading
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Annotated, Any, Final, Literal

from mcp.server.mcpserver import Context, MCPServer
from mcp.server.mcpserver.exceptions import ResourceError, ToolError
from mcp.server.transport_security import TransportSecuritySettings
from mcp_types import CallToolResult, InputRequiredResult, ToolAnnotations
from pydantic import Field
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from eventsrc.base.errors import MapfoldError, MisuseError
from projections.ask.find import Wanted, find
from projections.ask.goal_pose import CLEARANCE_M
from projections.ask.room_and_path import goal_of, path, room
from projections.edit.make import name_place, undo
from projections.localize.relocalize import rank, read_question
from projections.map.state_output import state_document, state_text

from .cited_maps import CitedMap, LiveMaps, LogMaps, offsets_in

PATH: Final = "/mcp"
MOST_OFFSETS: Final = 200
MOST_BYTES: Final = 1_000_000
_Text = Annotated[str, Field(min_length=1, max_length=256)]
_Top = Annotated[int, Field(ge=1, le=1000, description="Most answers.")]
_At = Annotated[
    str,
    Field(
        min_length=1,
        max_length=256,
        description="The moment of the map: a number of events, an ISO time, RUN:KEYFRAME or end.",
    ),
]
_KnownAt = Annotated[
    _Text | None, Field(description="Under the corrections before here; those before `at` if null.")
]
_Clearance = Annotated[float, Field(ge=0, le=100, description="Metres of the goal from walls.")]
_Time = Annotated[_Text | None, Field(description="ISO time with its date.")]
_Thing = Annotated[_Text, Field(description="X,Y in metres, a place or an object.")]
_Reason = Annotated[
    str, Field(pattern=r"\S", max_length=1000, description="Why; it becomes part of the log.")
]
_Part = Literal["places", "objects", "adjacency", "keyframes"]
_ABOUT: Final = """A robot's semantic map: places and objects, folded from a log of what it saw.
Each answer has `map` (the log, the number of its events that were folded, and the digest of the
map), `offsets` (events of the log that the answer rests on) and `answer`. Cite map and offsets.
Positions are metres in the map's frame, angles radians, times ISO 8601."""


class _Server(MCPServer[Any]):
    """Refuses arguments that a tool does not have, such as a misspelt one."""

    async def call_tool(
        self,
        name: str,
        arguments: dict[str, Any],
        context: Context[Any, Any] | None = None,
    ) -> CallToolResult | InputRequiredResult:
        for tool in await self.list_tools():
            known = tool.input_schema.get("properties", {})
            for given in arguments if tool.name == name else ():
                if given not in known:
                    there = ", ".join(known)
                    raise ToolError(f"{name} has no argument {given[:100]!r}; there are {there}")
        return await super().call_tool(name, arguments, context)


def create_server(maps: LogMaps | LiveMaps, *, allow_edits: bool = False) -> MCPServer[Any]:
    """The server; with ``allow_edits``, which needs a log, two of its tools record commands."""
    server = _Server(
        "mapfold", instructions=_ABOUT, version=version("mapfold"), log_level="WARNING"
    )
    tools = _Tools(maps)
    for tool in (
        *(tools.find, tools.room, tools.changes, tools.nearest, tools.path, tools.goal),
        *(tools.why, tools.where_am_i, tools.state),
    ):
        reads = ToolAnnotations(read_only_hint=True, open_world_hint=False)
        server.add_tool(_guarded(tool, tools.lock, ToolError), annotations=reads)
    if allow_edits and isinstance(maps, LogMaps):
        for edit in _edits(maps):
            writes = ToolAnnotations(read_only_hint=False, destructive_hint=False)
            server.add_tool(_guarded(edit, tools.lock, ToolError), annotations=writes)
    for uri, mime_type, read in (
        ("map://summary", "text/plain", tools.summary),
        ("map://picture", "image/png", tools.picture),
    ):
        resource = server.resource(uri, mime_type=mime_type)
        resource(_guarded(read, tools.lock, ResourceError))
    return server


def http_app(server: MCPServer[Any]) -> ASGIApp:
    """The server over HTTP at `PATH`, with no session: each request is answered by itself. Who may
    ask is checked by `serve.guard`. A GET, which would be a stream without end, is refused."""
    app = server.streamable_http_app(
        streamable_http_path=PATH,
        json_response=True,
        stateless_http=True,
        max_request_body_size=MOST_BYTES,
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),
    )

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] == "GET":
            await Response(status_code=405, headers={"Allow": "POST"})(scope, receive, send)
        else:
            await app(scope, receive, send)

    return answer


def _guarded(
    work: Callable[..., Any], lock: threading.Lock, error_type: type[Exception]
) -> Callable[..., Any]:
    """``work`` by one thread at a time, our errors as those that the SDK passes on."""

    @functools.wraps(work)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            with lock:
                return work(*args, **kwargs)
        except MapfoldError as error:
            raise error_type(str(error)) from None

    return guarded


class _Tools:
    """The read-only tools. Their docstrings are the descriptions that an agent gets."""

    def __init__(self, maps: LogMaps | LiveMaps) -> None:
        self.lock = threading.Lock()
        self._maps = maps

    def find(
        self,
        what: Annotated[
            _Text | None,
            Field(description="A class, such as chairs, what it looks like, or an object's id."),
        ] = None,
        room: Annotated[_Text | None, Field(description="The place that it is in.")] = None,
        near: Annotated[_Thing | None, Field(description="Nearest to this first.")] = None,
        start: Annotated[_Thing | None, Field(description="Nearest by way from here.")] = None,
        missing: bool = False,
        moved: bool = False,
        seen_since: _Time = None,
        not_seen_since: _Time = None,
        top: _Top = 10,
        every: Annotated[bool, Field(description="Also what was seen once.")] = False,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """Where things are: objects by class or id, in a place, near a point or thing, missing or
        moved, with when and by which run they were seen."""
        wanted = Wanted(
            what=what,
            room=room,
            near=near,
            start=start,
            missing=missing,
            moved=moved,
            seen_since=seen_since,
            not_seen_since=not_seen_since,
            top=top,
            every=every,
        )
        cited = self._maps.map(at, known_at)
        return _answer(cited, find(cited.view, wanted, self._maps.words(cited)).document())

    def room(self, name: _Text, at: _At = "end", known_at: _KnownAt = None) -> dict[str, Any]:
        """What a place is, what is in it, its neighbours, and when robots were there. It is named
        by its id (p3), a given name or a type of room."""
        cited = self._maps.map(at, known_at)
        return _answer(cited, room(cited.view, name).document())

    def changes(
        self,
        since: Annotated[
            _Text | None, Field(description="A day, run, time; the last run's start if null.")
        ] = None,
        until: Annotated[_Text, Field(description="A day, run, time or end.")] = "end",
    ) -> dict[str, Any]:
        """What changed in the building for sure: moved, missing, new and back again."""
        return _answer(*self._maps.changes(since, until))

    def nearest(
        self,
        near: _Thing,
        what: Annotated[_Text | None, Field(description="A class; anything if null.")] = None,
        by_way: Annotated[bool, Field(description="By the way a robot drives.")] = False,
        top: _Top = 3,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """The objects nearest to a point, a place or a thing."""
        straight, way = (None, near) if by_way else (near, None)
        return self.find(what, near=straight, start=way, top=top, at=at, known_at=known_at)

    def path(
        self,
        start: _Thing,
        end: _Thing,
        clearance: _Clearance = CLEARANCE_M,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """The way over ground that robots drove on: metres, places, passages, way points."""
        cited = self._maps.map(at, known_at)
        return _answer(cited, path(cited.view, start, end, clearance).document())

    def goal(
        self,
        thing: Annotated[_Text, Field(description="A class or an object's id.")],
        clearance: _Clearance = CLEARANCE_M,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """The pose to which a robot can drive and from which it sees a thing."""
        cited = self._maps.map(at, known_at)
        found = find(cited.view, Wanted(what=thing, top=1), self._maps.words(cited))
        if not found.answers:
            raise MisuseError(f"{thing!r} was seen once only, so there is no goal; ask by its id")
        best = found.answers[0]
        goal = goal_of(cited.view, best.object_id, clearance).document()
        return _answer(cited, goal, best.offsets)

    def why(
        self,
        thing: Annotated[_Text, Field(description="A place, an object, or RUN:KEYFRAME.")],
        other: Annotated[_Text | None, Field(description="The second RUN:KEYFRAME.")] = None,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """Why a place or an object is what it is, event by event; with two keyframes, since when
        they are in one place."""
        cited = self._maps.map(at, known_at)
        return _answer(cited, self._maps.why(thing, other, *cited.moment(at, known_at)))

    def where_am_i(
        self,
        crops: Annotated[
            list[dict[str, Any]],
            Field(
                min_length=1,
                description='What the robot sees: {"class"} and, if known, "embedding" (base64),'
                ' "embedding_dim", "embedding_model", "bbox" of each.',
            ),
        ],
        camera: Annotated[
            dict[str, Any] | None,
            Field(
                description='What took the boxes: {"hfov_deg", "width_px", "height_px"}, and'
                ' "yaw_rad" to the left where it does not look ahead.'
            ),
        ] = None,
        top: Annotated[int, Field(ge=1, le=100)] = 3,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """The likeliest places and the pose of a robot that sees some things, with a confidence;
        `unknown` is true where the map may not have them."""
        question = read_question({"crops": crops, "camera": camera})
        cited = self._maps.map(at, known_at)
        similar = self._maps.candidates(question.crops, *cited.moment(at, known_at))
        found = rank(question, similar, top=top)
        document = found.document()
        shown = {e["object_id"] for p in document["places"] for e in p["evidence"]}
        things = (each for each in cited.view.objects.values() if each.object_id in shown)
        seen = {int(k.offset) for each in things for k in cited.view.sightings(each)}
        return _answer(cited, document, seen)

    def state(
        self,
        parts: Annotated[
            list[_Part] | None,
            Field(description="Lists to give, by pages; places and adjacency if null."),
        ] = None,
        limit: Annotated[int, Field(ge=1, le=1000, description="Most of each list.")] = 100,
        first: Annotated[int, Field(ge=0, description="The first of each list.")] = 0,
        at: _At = "end",
        known_at: _KnownAt = None,
    ) -> dict[str, Any]:
        """The whole map: its counts and settings, and lists of its parts."""
        cited = self._maps.map(at, known_at)
        document = state_document(cited.view, cited.name.digest, cited.name.known_at)
        for part in ("places", "objects", "adjacency", "keyframes"):
            listed = document.pop(part)
            if part in (parts or ("places", "adjacency")):
                document[part] = listed[first : first + limit]
        last = cited.name.offset - 1
        return _answer(cited, document, {last} if last >= 0 else set())

    def summary(self) -> str:
        """The map as text: its counts, settings, digest and places."""
        cited = self._maps.map("end", None)
        text = state_text(cited.view, cited.name.digest, cited.name.known_at)
        return f"log {cited.name.log_id}, offset {cited.name.offset}\n{text}"

    def picture(self) -> bytes:
        """The map as a picture, in PNG."""
        from projections.adapters.drawing import map_png  # matplotlib: half a second to import

        cited = self._maps.map("end", None)
        digest = "" if cited.name.digest is None else f" {cited.name.digest[:8]}"
        return map_png(cited.view, f"map{digest} after {cited.name.offset:,} events")


def _edits(maps: LogMaps) -> tuple[Callable[..., Any], ...]:
    """The tools that record commands."""

    def name_a_place(
        place: Annotated[_Text, Field(description="Its id, name or type.")],
        name: Annotated[_Text, Field(description="The name that it gets.")],
        reason: _Reason,
    ) -> dict[str, Any]:
        """Give a place a name. It is recorded in the log, and can be undone."""
        done = maps.record(lambda at, stamp: name_place(at, stamp, place, name), reason)
        return _answer(maps.map("end", None), done)

    def undo_a_command(
        command_id: Annotated[_Text, Field(description="As `name_a_place` and `why` give it.")],
        reason: _Reason,
    ) -> dict[str, Any]:
        """Undo a command of the log. It is recorded in the log."""
        done = maps.record(lambda at, stamp: undo(at, stamp, command_id), reason)
        return _answer(maps.map("end", None), done)

    return name_a_place, undo_a_command


def _answer(
    cited: CitedMap, document: Mapping[str, Any], also: "set[int] | tuple[int, ...]" = ()
) -> dict[str, Any]:
    offsets = sorted(offsets_in(document) | set(also))
    more = len(offsets) - MOST_OFFSETS
    return {
        "map": cited.name.document(),
        "offsets": offsets[:MOST_OFFSETS],
        **({"more_offsets": more} if more > 0 else {}),
        "answer": document,
    }
