"""The service over HTTP: an ASGI app that describes itself at ``/openapi.json`` and ``/docs``.

Needs the extra ``mapfold[serve]`` (fastapi, uvicorn). Handlers run in a thread each, because the
databases are asked synchronously.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn
from fastapi import FastAPI, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from eventsrc.errors import MapfoldError, TransportError
from projections.errors import QuestionError

from .answering import DEFAULT_RADIUS_M, MAX_TOP, Answerer, refusal

_EXAMPLE = {"crops": [{"class": "cup", "bbox": [120, 80, 250, 310], "embedding": "<base64>"}]}
_QUESTION = {
    "requestBody": {
        "required": True,
        "description": "An envelope, a list of detections, or an object with crops.",
        "content": {"application/json": {"schema": {}, "example": _EXAMPLE}},
    }
}


_REFUSED: dict[int | str, dict[str, Any]] = {
    status: {
        "description": text,
        "content": {
            "application/json": {"example": {"error": {"kind": kind, "message": "what and why"}}}
        },
    }
    for status, text, kind in (
        ("4XX", "A question that cannot be answered, or too many of them", "bad_question"),
        ("5XX", "The database cannot be asked just now", "database"),
    )
}
_DRAINED = 8


def create_app(answerer: Answerer) -> FastAPI:
    """The ASGI application; it owns nothing, so closing the pools is its maker's business."""
    app = FastAPI(
        title="mapfold",
        summary="Where is the robot, and what stands near a pose?",
        responses=_REFUSED,
    )
    _refuse_in_our_words(app)

    @app.post(
        "/relocalize", summary="Ranked Places, a pose and a confidence", openapi_extra=_QUESTION
    )
    async def relocalize(
        request: Request,
        top: int | None = Query(None, ge=1, le=MAX_TOP),
        method: str | None = None,
    ) -> dict[str, Any]:
        payload = await _limited(request, answerer.max_bytes)
        given = {"top": top, "method": method}
        options = {name: str(value) for name, value in given.items() if value is not None}
        return await run_in_threadpool(answerer.relocalize, payload, options)

    @app.get("/state/{what}", summary="places or objects near a pose, nearest first")
    def state(what: str, x: float, y: float, radius: float = DEFAULT_RADIUS_M) -> dict[str, Any]:
        return answerer.state(what, {"x": str(x), "y": str(y), "radius": str(radius)})

    @app.get("/health", summary="200 while questions can be answered, else 503")
    def health() -> dict[str, str]:
        return answerer.health()

    return app


def _refuse_in_our_words(app: FastAPI) -> None:
    """Every refusal has the same form, whoever finds the question wrong."""

    @app.exception_handler(MapfoldError)
    def refuse(_: Request, error: MapfoldError) -> JSONResponse:
        status, document = refusal(error)
        return JSONResponse(document, status)

    @app.exception_handler(RequestValidationError)
    def refuse_parameter(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        found = "missing" if first["type"] == "missing" else repr(first["input"])
        said = f"{first['loc'][-1]} is {found}; {first['msg'].lower()}"
        status, document = refusal(QuestionError(said))
        return JSONResponse(document, status)

    @app.exception_handler(HTTPException)
    def refuse_path(request: Request, error: HTTPException) -> JSONResponse:
        said = f"{request.method} {request.url.path}: {error.detail}; /docs tells what there is"
        _, document = refusal(QuestionError(said))
        return JSONResponse(document, error.status_code, headers=error.headers)


async def _limited(request: Request, most: int) -> bytes:
    """The body; refused when it is longer than ``most``, of which no more is kept.

    Some of what is too long is still read: a client that is cut off while sending sees a broken
    connection and not the reason.
    """
    body, length = bytearray(), 0
    async for part in request.stream():
        length += len(part)
        body += part if length <= most else b""
        if length > _DRAINED * most:
            break
    if length > most:
        raise QuestionError(f"the question has more than {most} bytes; send fewer crops")
    return bytes(body)


@contextmanager
def serving(app: FastAPI, host: str, port: int) -> Iterator[int]:
    """Serve in a thread; yields the port. Ends gracefully: requests under way are answered."""
    config = uvicorn.Config(app, host=host, port=port, log_level="warning", lifespan="off")
    server = uvicorn.Server(config)
    listener = _bind(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="http")
    thread.start()
    try:
        yield int(listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def _bind(config: uvicorn.Config) -> Any:
    import socket

    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    listener = socket.socket(family)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((config.host, config.port))
        listener.listen(128)  # from now on clients wait instead of being refused
    except OSError as error:
        listener.close()
        raise TransportError(
            f"http {config.host}:{config.port}: {error.strerror or error}; give --http another"
        ) from None
    return listener
