"""The service over HTTP: an ASGI app with its description at ``/openapi.json`` and ``/docs``.

Answers are described by the models in `models` and sent without validation by them.

Needs the extra ``mapfold[serve]`` (fastapi, uvicorn). The event loop only reads requests; the
threads of the `FairQueue` answer them, because database access is synchronous.
"""

import asyncio
import hashlib
from collections.abc import Callable, Collection, Sequence
from functools import cache
from typing import Annotated, Any, Final

from fastapi import Depends, FastAPI, Path, Query, Request, Security
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.security import HTTPBearer
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from eventsrc.base.errors import MapfoldError
from eventsrc.record.metrics import METRICS_TYPE
from projections.ask.find import FoundObject
from projections.ask.goal_pose import CLEARANCE_M, GoalPose
from projections.ask.room_and_path import DrivenPath, Room
from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import Method, describe_value

from .answering import MAX_NAME, MAX_TOP, OPTIONS, Answerer, TooMuchError, encode, refusal
from .asked import (
    FIND_NAMES,
    MOST_TEXT,
    ChangesPageShape,
    ChangesQuery,
    FindQuery,
    FoundPageShape,
    goal_question,
    object_question,
    path_question,
    room_question,
)
from .connections import peer_of
from .description import CROP, EXAMPLES, METRICS, QUESTION, add_docs, refusals, state_parameter
from .fair_queue import FairQueue
from .models import AnswerShape, Health, ObjectsShape, PlacesShape, StateQuery
from .service_metrics import ServiceMetrics
from .states import State, refuse_unknown

_DRAIN_FACTOR: Final = 8
_KEPT: Final = "private, no-cache"
_NAME: Final = Path(min_length=1, max_length=MOST_TEXT)
_CLEARANCE = Annotated[float, Query(ge=0, le=100, description="Metres of a goal from walls.")]
_END: Final = "X,Y in metres, a Place or an Object; the way to an Object ends at its goal."
_RETRY_AFTER: Final = {"Retry-After": "1"}
_ABOUT: Final = """Answers come from the map as it is in the databases when they are asked; what
changed since another moment, from the log beside them.

Every refusal is `{"error": {"kind", "message"}}`. HEAD is answered like GET, without the body. A
parameter that a path does not have, that is empty or that is given twice is refused with 400,
except at `/health` and `/metrics`: monitors add parameters of their own.
"""


def create_app(
    answerer: Answerer,
    queue: FairQueue,
    metrics: ServiceMetrics | None = None,
    *,
    secured: bool = False,
) -> FastAPI:
    """The ASGI app; the caller closes pools and queue. ``secured``: `Guard` checks a token."""
    counted = metrics or ServiceMetrics(answerer, queue)
    app = FastAPI(
        title="mapfold",
        summary="Re-localisation, and the Places and Objects of the map",
        description=_ABOUT,
        docs_url=None,  # FastAPI's pages load scripts from other servers
        redoc_url=None,
        openapi_url=None,  # its path would take any parameter; added below
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,
        dependencies=_security(secured),
    )
    _add_error_handlers(app)
    app.add_middleware(HeadLikeGet)
    add_docs(app, [only()])

    async def answered(request: Request, what: str, work: Callable[[], Any]) -> Response:
        peer = "" if request.client is None else peer_of(request.client.host)
        future = queue.submit(peer, lambda: encode(work()))
        counted.watch("http", what, future)
        return Response(await asyncio.wrap_future(future), media_type="application/json")

    # Each returns a Response, which is sent as it is: response_model only describes it.

    @app.post(
        "/relocalize",
        summary="Ranked Places, a pose and a confidence",
        openapi_extra=QUESTION,
        response_model=AnswerShape,
        responses=refusals(asking=True),
        dependencies=[only(*OPTIONS)],
    )
    async def relocalize(
        request: Request,
        top: Annotated[
            int | None, Query(ge=1, le=MAX_TOP, description="Most Places; 3 if not given.")
        ] = None,
        method: Annotated[Method | None, Query(description="joint if not given.")] = None,
        session: Annotated[
            str | None,
            Query(
                min_length=1,
                max_length=MAX_NAME,
                description="Track the questions of this name, by the method joint.",
            ),
        ] = None,
    ) -> Response:
        payload = await read_body(request, answerer.max_bytes)
        given = {"top": top, "method": method, "session": session}
        options = {name: str(value) for name, value in given.items() if value is not None}
        return await answered(request, "relocalize", lambda: answerer.relocalize(payload, options))

    @app.get(
        "/state/{what}",
        summary="Places or objects near a position, nearest first, or all of them",
        description="With `x` and `y` those near that position. Without, all of them by pages: ask"
        " again with `next` of the answer as `cursor` until it is null.",
        response_model=PlacesShape | ObjectsShape,
        responses=refusals(asking=True),
        dependencies=[only(*StateQuery.model_fields)],
    )
    async def state(
        request: Request,
        what: Annotated[State, Path()],
        asked: Annotated[StateQuery, Query()],
    ) -> Response:
        given = asked.model_dump(exclude_none=True)
        options = {name: str(value) for name, value in given.items()}
        return await answered(request, what, lambda: answerer.state(what, options))

    @app.get(
        "/find",
        summary="Objects by class or id, best first, with where and when they were seen",
        response_model=FoundPageShape,
        responses=refusals(asking=True),
        dependencies=[only(*FIND_NAMES)],
    )
    async def find(request: Request, wanted: Annotated[FindQuery, Query()]) -> Response:
        return await answered(request, "find", lambda: answerer.find(wanted))

    @app.get(
        "/rooms/{name}",
        summary="A Place: what it is, what is in it, its neighbours, when robots were there",
        response_model=Room,
        responses=refusals(asking=True),
        dependencies=[only()],
    )
    async def room(request: Request, name: Annotated[str, _NAME]) -> Response:
        return await answered(request, "room", lambda: answerer.ask(room_question(name)))

    @app.get(
        "/objects/{name}",
        summary="An Object by its id, the first six characters of it or more, or its class",
        response_model=FoundObject,
        responses=refusals(asking=True),
        dependencies=[only()],
    )
    async def object_(request: Request, name: Annotated[str, _NAME]) -> Response:
        return await answered(request, "object", lambda: answerer.ask(object_question(name)))

    @app.get(
        "/objects/{name}/goal",
        summary="The pose from which a robot sees an Object",
        response_model=GoalPose,
        responses=refusals(asking=True),
        dependencies=[only("clearance")],
    )
    async def goal(
        request: Request, name: Annotated[str, _NAME], clearance: _CLEARANCE = CLEARANCE_M
    ) -> Response:
        question = goal_question(name, clearance)
        return await answered(request, "goal", lambda: answerer.ask(question))

    @app.get(
        "/path",
        summary="The way over driven ground between two points, Places or Objects",
        response_model=DrivenPath,
        responses=refusals(asking=True),
        dependencies=[only("from", "to", "clearance")],
    )
    async def path(
        request: Request,
        start: Annotated[
            str, Query(alias="from", min_length=1, max_length=MOST_TEXT, description=_END)
        ],
        end: Annotated[
            str, Query(alias="to", min_length=1, max_length=MOST_TEXT, description=_END)
        ],
        clearance: _CLEARANCE = CLEARANCE_M,
    ) -> Response:
        question = path_question(start, end, clearance)
        return await answered(request, "path", lambda: answerer.ask(question))

    @app.get(
        "/changes",
        summary="What changed in the building between two moments, by pages; needs --log",
        response_model=ChangesPageShape,
        responses=refusals(asking=True),
        dependencies=[only(*ChangesQuery.model_fields)],
    )
    async def changes(request: Request, wanted: Annotated[ChangesQuery, Query()]) -> Response:
        return await answered(request, "changes", lambda: answerer.changes(wanted))

    @app.get(
        "/crops/{name:path}",
        summary="The crop of a detection, or of an Object's best view; needs --log",
        response_class=Response,
        responses=refusals(asking=True) | CROP,
        dependencies=[only()],
    )
    async def crop(request: Request, name: Annotated[str, _NAME]) -> Response:
        peer = "" if request.client is None else peer_of(request.client.host)
        future = queue.submit(peer, lambda: answerer.crop(name))
        counted.watch("http", "crop", future)
        jpeg = await asyncio.wrap_future(future)
        headers = {"ETag": f'"{hashlib.sha256(jpeg).hexdigest()[:16]}"', "Cache-Control": _KEPT}
        if request.headers.get("if-none-match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
        return Response(jpeg, media_type="image/jpeg", headers=headers)

    @app.get(
        "/health",
        summary="200 while questions can be answered, else 503",
        response_model=Health,
        responses=refusals(asking=True),
    )
    async def health(request: Request) -> Response:
        return await answered(request, "health", answerer.health)

    @app.get(
        "/metrics",
        summary="Metrics for Prometheus",
        response_class=Response,
        responses=METRICS | refusals(),
    )
    async def metrics_text() -> Response:
        return Response(counted.text(), media_type=METRICS_TYPE)

    add_openapi(app, only())
    _complete_description(app)
    return app


def only(*names: str, repeated: Collection[str] = ()) -> Any:
    """A dependency of a path that refuses query parameters other than ``names``, empty ones, and
    those given twice that are not in ``repeated``."""

    async def check(request: Request) -> None:
        query = request.query_params
        refuse_unknown(query, names)
        for name in query:
            values = query.getlist(name)
            if "" in values:
                raise QuestionError(f"{name} is empty; give a value, or leave {name} out")
            if len(values) > 1 and name not in repeated:
                raise QuestionError(f"{name} is given {len(values)} times; give it once")

    return Depends(check)


def add_openapi(app: FastAPI, parameters: Any) -> None:
    """Add ``/openapi.json``, with the dependency ``parameters`` of `only`."""

    @app.get("/openapi.json", include_in_schema=False, dependencies=[parameters])
    async def openapi() -> JSONResponse:
        return JSONResponse(app.openapi())


def _complete_description(app: FastAPI) -> None:
    """Correct FastAPI's description: refusals have status 400 instead of 422, query parameters
    cannot be null, those of ``/state`` depend on each other, and examples keep their nulls."""
    described = app.openapi

    @cache  # FastAPI keeps the document, too, and it must be corrected once
    def openapi() -> dict[str, Any]:
        document = described()
        for path in document["paths"].values():
            for operation in path.values():
                operation["responses"].pop("422", None)
                for parameter in operation.get("parameters", ()):
                    _drop_null(parameter["schema"])
        state = document["paths"]["/state/{what}"]["get"]
        what, *query = state["parameters"]
        state["parameters"] = [what, state_parameter(query)]
        for name in ("HTTPValidationError", "ValidationError"):
            document["components"]["schemas"].pop(name, None)
        for path, method, shown in EXAMPLES:
            content = document["paths"][path][method]["responses"]["200"]["content"]
            content["application/json"]["example"] = shown
        return document

    app.openapi = openapi  # type: ignore[method-assign]


def _drop_null(schema: dict[str, Any]) -> None:
    others = [form for form in schema.get("anyOf", ()) if form != {"type": "null"}]
    if len(others) == 1:
        del schema["anyOf"]
        schema.update(others[0])


def _security(secured: bool) -> Sequence[Any]:
    scheme = HTTPBearer(scheme_name="token", auto_error=False, description="--token-file")
    return [Security(scheme)] if secured else []


class HeadLikeGet:
    """ASGI middleware that answers HEAD as GET is answered, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def send_without_body(message: Message) -> None:
            if message["type"] == "http.response.body":
                message = {**message, "body": b""}
            await send(message)

        await self._app({**scope, "method": "GET"}, receive, send_without_body)


def _add_error_handlers(app: FastAPI) -> None:
    """Give all refusals, also those of FastAPI, the same JSON form."""

    @app.exception_handler(MapfoldError)
    async def refuse(_: Request, error: MapfoldError) -> JSONResponse:
        status, document = refusal(error)
        headers = _RETRY_AFTER if isinstance(error, TooMuchError) else None
        return JSONResponse(document, status, headers)

    @app.exception_handler(RequestValidationError)
    async def refuse_parameter(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        found = "missing" if first["type"] == "missing" else describe_value(first["input"])
        name = "the end of the path" if first["loc"][0] == "path" else first["loc"][-1]
        message = f"{name} is {found}; {first['msg'].lower()}"
        status, document = refusal(QuestionError(message))
        return JSONResponse(document, status)

    @app.exception_handler(HTTPException)
    async def refuse_path(request: Request, error: HTTPException) -> JSONResponse:
        asked = f"{request.method} {describe_value(request.scope['path'])}"
        message = f"{asked}: {error.detail}; see /docs"
        _, document = refusal(QuestionError(message))
        headers = dict(error.headers or {})
        if "Allow" in headers:  # of some paths in an order that changes, without HEAD of others
            methods = set(headers["Allow"].split(", "))
            methods |= {"HEAD"} if "GET" in methods else set()
            headers["Allow"] = ", ".join(sorted(methods))
        return JSONResponse(document, error.status_code, headers=headers)

    @app.exception_handler(ClientDisconnect)
    async def disconnected(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)

    @app.exception_handler(Exception)
    async def failed(_: Request, __: Exception) -> JSONResponse:  # uvicorn logs the exception
        status, document = refusal(MapfoldError())
        return JSONResponse(document, status)


async def read_body(request: Request, most: int) -> bytes:
    """The body, at most ``most`` bytes. Raises QuestionError for a longer or a compressed one.

    Some of a longer one is still read: a client that is cut off while sending sees a broken
    connection instead of the reason.
    """
    body, length = bytearray(), 0
    async for part in request.stream():
        length += len(part)
        body += part if length <= most else b""
        if length > _DRAIN_FACTOR * most:
            break
    if length > most:
        raise QuestionError(f"the question has more than {most} bytes; send less")
    encoding = request.headers.get("content-encoding", "identity")
    if encoding.lower() != "identity":
        raise QuestionError(
            f"Content-Encoding is {describe_value(encoding)}; send the body uncompressed"
        )
    return bytes(body)
