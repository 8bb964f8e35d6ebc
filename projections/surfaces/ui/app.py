"""The page and its interface as an ASGI app.

Needs the extra ``mapfold[ui]`` (fastapi, uvicorn). The event loop only reads requests; the threads
of `UiService` answer them.
"""

import asyncio
import contextlib
import functools
import hashlib
import mimetypes
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from html import escape
from pathlib import Path
from typing import Any, Final, NamedTuple

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import visible
from eventsrc.envelope.model import Offset
from projections.surfaces.serve.answering import TooMuchError
from projections.surfaces.serve.http import add_openapi, only, read_body

from .comparisons import (
    WHATIF_OPTIONS,
    bisect_answer,
    changes_answer,
    conditions_answer,
    diff_answer,
    merges_answer,
    whatif_answer,
)
from .crop_pictures import pictures_answer
from .editor import MOST_BYTES as MOST_EDIT_BYTES
from .editor import Editor, corrections_answer, read_edit
from .live_watch import MOST_STREAMS, LiveWatch
from .localizing import MOST_BYTES, question_answer
from .log_map import LogMap
from .map_answers import digest_answer, history_answer, overview_answer, walls_answer
from .question_threads import GoOn, UiService
from .requests import assignments_of, encoded, refusal
from .search import find_answer, keyframe_answer, path_answer, search_answer
from .stories import why_answer
from .token_gate import EDIT_PATH

_FOLDER: Final = Path(__file__).with_name("static")
_TYPES: Final = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_NO_PAGE: Final = b"""<!doctype html><meta charset="utf-8"><title>mapfold</title>
<p>The page is not built in this installation; its interface answers below /api/.</p>
"""


class StaticFile(NamedTuple):
    """A file as it is sent."""

    content: bytes
    media_type: str
    etag: str


def static_files() -> dict[str, StaticFile]:
    """The files by URL path; ``/`` is index.html."""
    found = {
        f"/{path.relative_to(_FOLDER).as_posix()}": _read(path)
        for path in sorted(_FOLDER.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }
    found["/"] = found.get("/index.html") or _static(_NO_PAGE, "text/html")
    return found


def _read(path: Path) -> StaticFile:
    guessed = _TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    return _static(path.read_bytes(), guessed or "application/octet-stream")


def _static(content: bytes, media_type: str) -> StaticFile:
    return StaticFile(content, media_type, f'"{hashlib.sha256(content).hexdigest()[:16]}"')


HEADERS: Final = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; object-src 'none';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Security headers of every response that does not set them: own host only, no inline code, no
sniffed types."""

_SETTINGS: Final = ("set", "eps_m", "min_samples")
_AT_W: Final = ("at", "known_at", *_SETTINGS)
_BINARY = "application/octet-stream"
_MAX_SHOWN = 200


def _only(*names: str) -> Any:
    """`only`, with the token of the printed link, which `TokenGate` takes on every path."""
    return only(*names, "token", repeated=("set", *WHATIF_OPTIONS))


def create_app(service: UiService, watch: LiveWatch, editor: Editor | None = None) -> FastAPI:
    """The ASGI application. The caller closes the service and the watch. `TokenGate` controls
    access to the ``editor``."""
    app = FastAPI(
        title="mapfold ui", openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False
    )
    _add_error_handlers(app)
    files = static_files()

    @app.get(
        "/api/log",
        summary="The log, its runs and settings, and what is wrong with it",
        dependencies=[_only()],
    )
    async def log() -> Response:
        return _json(service.log_document())

    @app.get(
        "/api/history",
        summary="Everything that happened to the map, as binary arrays",
        dependencies=[_only("from", "known_at", *_SETTINGS)],
    )
    async def history(request: Request) -> Response:
        query = request.query_params

        def work(shown: LogMap, refold_s: float) -> bytes:
            return history_answer(shown, query, refold_s)

        content = await _answer(service, request, work)
        return Response(content, media_type=_BINARY)

    def answers(
        path: str, summary: str, answer: Callable[..., dict[str, Any]], *names: str
    ) -> None:
        """Add a question about the map that is answered with a document, and the ``names`` of its
        parameters."""

        @app.get(f"/api/{path}", summary=summary, name=path, dependencies=[_only(*names)])
        async def answered(request: Request) -> Response:
            query = request.query_params

            def work(shown: LogMap, refold_s: float) -> bytes:
                document = answer(shown, query)
                more = {"refold_ms": round(refold_s * 1e3, 1)} if assignments_of(query) else {}
                return encoded({"through": shown.through, **document, **more})

            content = await _answer(service, request, work)
            return Response(content, media_type="application/json")

    answers("overview", "The rooms of the map at W, and what is odd", overview_answer, *_AT_W)
    answers("digest", "The digest of the map at W", digest_answer, *_AT_W)
    answers("walls", "The walls of an occupancy map of the log", walls_answer, "number")
    answers(
        "why",
        "Why a place, object or keyframe is what it is; why places merged",
        why_answer,
        "what",
        "other",
        *_AT_W,
    )
    answers("merges", "Every merge of places up to W", merges_answer, *_AT_W)
    answers(
        "diff",
        "What changed from one moment to another",
        diff_answer,
        "from",
        "to",
        "known_at",
        *_SETTINGS,
    )
    moments = ("since", "until", "known_at")
    answers("changes", "What changed in the building for sure", changes_answer, *moments)
    answers(
        "bisect",
        "The event that made a condition true",
        bisect_answer,
        "condition",
        "from",
        "to",
        "scan",
        "known_at",
        *_SETTINGS,
    )
    answers(
        "conditions", "The functions of conditions, and the error in one", conditions_answer, "text"
    )
    find_parameters = ("what", "in", "near", "top", "all")
    answers("find", "Where things are", find_answer, *find_parameters, *_AT_W)
    answers(
        "path", "The way between two things, and the goal at one", path_answer, "from", "to", *_AT_W
    )
    answers("search", "Things whose name matches a text", search_answer, "q", "kind", *_AT_W)
    answers(
        "keyframe", "A keyframe and its detections", keyframe_answer, "number", "keyframe", *_AT_W
    )

    answers("pictures", "Crops of an object or a keyframe", pictures_answer, "what", "top", *_AT_W)

    async def apart(
        request: Request, work: Callable[[Offset, GoOn], bytes], *, folds: bool = True
    ) -> Response:
        ask = functools.partial(service.ask_apart, work, folds=folds)
        return Response(await _awaited(request, ask), media_type="application/json")

    @app.get(
        "/api/corrections",
        summary="The commands of the log, and what is undone",
        dependencies=[_only()],
    )
    async def corrections(request: Request) -> Response:
        def work(end: Offset, go_on: GoOn) -> bytes:
            return encoded(corrections_answer(service.opened, end, go_on))

        return await apart(request, work, folds=False)

    @app.get(
        "/api/whatif",
        summary="The map under other settings, or without a command",
        dependencies=[_only(*WHATIF_OPTIONS, *_AT_W)],
    )
    async def whatif(request: Request) -> Response:
        query = request.query_params

        def work(end: Offset, go_on: GoOn) -> bytes:
            return encoded(whatif_answer(service.opened, end, query, go_on))

        return await apart(request, work)

    answers(
        "question",
        "A mapped keyframe's crops as a question",
        question_answer,
        "number",
        "keyframe",
        "near",
        "floor",
        *_AT_W,
    )

    @app.post(
        "/api/relocalize",
        summary="Where a robot is that sees some crops, by the map at W",
        dependencies=[_only("top", "at", *_SETTINGS)],
    )
    async def relocalize(request: Request) -> Response:
        query, payload = request.query_params, await read_body(request, MOST_BYTES)

        def work(end: Offset, go_on: GoOn) -> bytes:
            return encoded(service.localizer.answer(end, query, payload, go_on))

        return await apart(request, work)

    if editor is not None:

        @app.post(
            EDIT_PATH,
            summary="Give a command, or see what it would change",
            dependencies=[_only()],
        )
        async def edit(request: Request) -> Response:
            asked = read_edit(await read_body(request, MOST_EDIT_BYTES))

            def work(end: Offset, go_on: GoOn) -> dict[str, Any]:
                return editor.answer(end, asked, go_on)

            if asked.dry_run and asked.kind == "name-place":  # a name needs no other fold

                def rename(shown: LogMap, _: float) -> bytes:
                    document = editor.answer(shown.through, asked, lambda: None, shown.timeline.at)
                    return encoded(document)

                found = await _answer(service, request, rename)
                return Response(found, media_type="application/json")
            if asked.dry_run:
                return await apart(request, lambda end, go_on: encoded(work(end, go_on)))
            future = service.ask_apart(work)  # recorded also when the page leaves meanwhile
            document = await asyncio.wrap_future(future)
            # It is recorded; what is wrong with the log now is among the log's problems.
            with contextlib.suppress(MapfoldError):
                await asyncio.wrap_future(service.refresh())
            return _json(document | {"through": service.log_document()["through"]})

    @app.get(
        "/api/live",
        summary="Server-sent events: what is new in the log",
        dependencies=[_only()],
    )
    async def live() -> Response:
        if watch.is_full:
            raise TooMuchError(
                f"{MOST_STREAMS} pages follow this log already; close one and load this page again"
            )
        return StreamingResponse(watch.stream(), media_type="text/event-stream")

    add_openapi(app, _only())

    @app.get("/docs", include_in_schema=False, dependencies=[_only()])
    async def docs() -> Response:
        return Response(_docs_page(app.openapi()), media_type="text/html")

    # Parameters of the page's address are for its script.
    @app.get("/{path:path}", include_in_schema=False)
    async def static(request: Request) -> Response:
        found = files.get(request.scope["path"])
        if found is None:
            raise HTTPException(404)
        # A link with the token is in no cache.
        kept = "no-store" if request.url.query else "no-cache"
        headers = {"ETag": found.etag, "Cache-Control": kept}
        if request.headers.get("if-none-match") == found.etag:
            return Response(status_code=304, headers=headers)
        return Response(found.content, media_type=found.media_type, headers=headers)

    return app


async def _answer(
    service: UiService, request: Request, work: Callable[[LogMap, float], bytes]
) -> bytes:
    """The answer of ``work`` under the settings of the request."""
    sets = assignments_of(request.query_params)
    return await _awaited(request, functools.partial(service.ask, sets, work))


async def _awaited(
    request: Request, submit: Callable[[Callable[[], bool]], Future[bytes]]
) -> bytes:
    """The result. When the client disconnects, work that has not begun is dropped."""
    here = True
    answered = asyncio.ensure_future(asyncio.wrap_future(submit(lambda: here)))
    leaving = asyncio.ensure_future(_disconnect(request))
    try:
        await asyncio.wait((answered, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not answered.done():
            answered.cancel()
            raise ClientDisconnect
        return answered.result()
    finally:
        here = False
        leaving.cancel()


async def _disconnect(request: Request) -> None:
    """Return when the client has disconnected."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _docs_page(schema: Mapping[str, Any]) -> bytes:
    """A table of the questions of an OpenAPI ``schema``; FastAPI's own page loads its code from
    another host."""
    rows = [
        f"<tr><td><code>{escape(method.upper())} {escape(path)}</code><td>{escape(each['summary'])}"
        for path, methods in schema["paths"].items()
        for method, each in methods.items()
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>mapfold ui</title>'
        "<h1>What this server answers</h1><p>In full in docs/ui.md of mapfold; for programs:"
        ' <a href="/openapi.json">openapi.json</a>.</p><table>' + "".join(rows) + "</table></html>"
    ).encode()


def _json(document: Mapping[str, Any], status: int = 200) -> Response:
    return Response(encoded(document), status, media_type="application/json")


def _add_error_handlers(app: FastAPI) -> None:
    """Give all refusals, also those of FastAPI, the same JSON form."""

    @app.exception_handler(MapfoldError)
    async def refuse(_: Request, error: MapfoldError) -> Response:
        status, document = refusal(error)
        return _json(document, status)

    @app.exception_handler(HTTPException)
    async def refuse_path(request: Request, error: HTTPException) -> Response:
        asked = visible(f"{request.method} {request.scope['path']}"[:_MAX_SHOWN])
        document = {"error": {"kind": "bad_question", "message": f"{asked}: {error.detail}"}}
        return JSONResponse(document, error.status_code, headers=error.headers)

    @app.exception_handler(ClientDisconnect)
    async def disconnected(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)

    @app.exception_handler(Exception)
    async def failed(_: Request, __: Exception) -> Response:  # uvicorn logs the exception
        message = "failed; see the program's stderr"
        return _json({"error": {"kind": "failed", "message": message}}, 500)
