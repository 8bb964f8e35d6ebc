"""The service over HTTP: an ASGI app with its description at ``/openapi.json`` and ``/docs``.

Needs the extra ``mapfold[serve]`` (fastapi, uvicorn). The event loop only reads requests; the
threads of the `FairQueue` answer them, because database access is synchronous.
"""

import asyncio
import base64
import struct
from collections.abc import Callable
from typing import Any, get_args

from fastapi import FastAPI, Path, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from eventsrc.errors import MapfoldError
from projections.errors import QuestionError
from projections.relocalize import Method, describe_value, question_schema

from .answering import DEFAULT_RADIUS_M, MAX_TOP, STATES, Answerer, TooMuchError, encode, refusal
from .connections import peer_of
from .fair_queue import FairQueue
from .sessions import MAX_NAME

_EMBEDDING = base64.b64encode(struct.pack("<512f", 1.0, *[0.0] * 511)).decode()
_CROP = {
    "class": "cup",
    "bbox": [120, 80, 250, 310],
    "embedding": _EMBEDDING,
    "embedding_dim": 512,
}
_EXAMPLES = {
    "one picture": {"value": {"crops": [_CROP]}},
    "a robot that turned a quarter to the left between two pictures": {
        "value": {
            "views": [{"crops": [_CROP]}, {"dx": 0.0, "dy": 0.0, "dyaw": 1.57, "crops": [_CROP]}]
        }
    },
    "near a toilet and a mirror": {"value": {"crops": [{"class": "toilet"}, {"class": "mirror"}]}},
}
_OPTIONS = {
    "top": {"type": "integer", "minimum": 1, "maximum": MAX_TOP, "default": 3},
    "method": {"type": "string", "enum": list(get_args(Method)), "default": "joint"},
    "session": {
        "type": "string",
        "minLength": 1,
        "maxLength": MAX_NAME,
        "description": "Track the questions of this name.",
    },
}
"""What the service reads of a question beside what every question has."""
_QUESTION = {
    "requestBody": {
        "required": True,
        "description": "An envelope, a list of detections, or an object with crops or views.",
        "content": {
            "application/json": {"schema": question_schema(_OPTIONS), "examples": _EXAMPLES}
        },
    }
}


_REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {
        "description": text,
        "content": {
            "application/json": {"example": {"error": {"kind": kind, "message": "what and why"}}}
        },
    }
    for status, text, kind in (
        ("4XX", "A question that cannot be answered, or may not be asked", "bad_question"),
        ("5XX", "No answer just now: the database is away, or too many ask", "database"),
    )
}
_DRAIN_FACTOR = 8
_RETRY_AFTER = {"Retry-After": "1"}


def create_app(answerer: Answerer, queue: FairQueue) -> FastAPI:
    """The ASGI application. The caller closes the pools and the queue."""
    app = FastAPI(
        title="mapfold",
        summary="Where is the robot, and what stands near a pose?",
        responses=_REFUSALS,
        redirect_slashes=False,
    )
    _add_error_handlers(app)
    app.add_middleware(HeadLikeGet)

    async def answered(request: Request, work: Callable[[], dict[str, Any]]) -> Response:
        peer = "" if request.client is None else peer_of(request.client.host)
        future = queue.submit(peer, lambda: encode(work()))
        return Response(await asyncio.wrap_future(future), media_type="application/json")

    @app.post(
        "/relocalize", summary="Ranked Places, a pose and a confidence", openapi_extra=_QUESTION
    )
    async def relocalize(
        request: Request,
        top: int | None = Query(None, ge=1, le=MAX_TOP),
        method: str | None = Query(None, json_schema_extra={"enum": list(get_args(Method))}),
        session: str | None = Query(None, description="Track the questions of this name."),
    ) -> Response:
        payload = await read_body(request, answerer.max_bytes)
        given = {"top": top, "method": method, "session": session}
        options = {name: str(value) for name, value in given.items() if value is not None}
        return await answered(request, lambda: answerer.relocalize(payload, options))

    @app.get("/state/{what}", summary="places or objects near a pose, nearest first")
    async def state(
        request: Request,
        x: float,
        y: float,
        what: str = Path(json_schema_extra={"enum": [*STATES]}),
        radius: float = DEFAULT_RADIUS_M,
    ) -> Response:
        options = {"x": str(x), "y": str(y), "radius": str(radius)}
        return await answered(request, lambda: answerer.state(what, options))

    @app.get("/health", summary="200 while questions can be answered, else 503")
    async def health(request: Request) -> Response:
        return await answered(request, answerer.health)

    return app


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
        message = f"{first['loc'][-1]} is {found}; {first['msg'].lower()}"
        status, document = refusal(QuestionError(message))
        return JSONResponse(document, status)

    @app.exception_handler(HTTPException)
    async def refuse_path(request: Request, error: HTTPException) -> JSONResponse:
        asked = f"{request.method} {describe_value(request.scope['path'])}"
        message = f"{asked}: {error.detail}; see /docs"
        _, document = refusal(QuestionError(message))
        return JSONResponse(document, error.status_code, headers=error.headers)

    @app.exception_handler(ClientDisconnect)
    async def disconnected(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)

    @app.exception_handler(Exception)
    async def failed(_: Request, __: Exception) -> JSONResponse:  # uvicorn logs the exception
        status, document = refusal(MapfoldError())
        return JSONResponse(document, status)


async def read_body(request: Request, most: int) -> bytes:
    """The body, at most ``most`` bytes. Raises QuestionError for a longer one.

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
    return bytes(body)
