"""The OpenAPI description at ``/openapi.json``, with examples and all refusals, and its page at
``/docs``: Swagger UI, with nothing loaded from other servers.

The files of Swagger UI are those of the package fastapi-offline, which only this module imports. By
its Content-Security-Policy the page may load from and connect to this server only; its own script
is a file too, because inline scripts are not allowed.
"""

import base64
import struct
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from typing import Any, Final, get_args

from fastapi import APIRouter, FastAPI
from fastapi.responses import Response

from projections.localize.relocalize import Method, question_schema

from .answering import MAX_NAME, MAX_TOP
from .models import RefusalShape

_EMBEDDING: Final = base64.b64encode(struct.pack("<512f", 1.0, *[0.0] * 511)).decode()
_CROP: Final = {
    "class": "mirror",
    "bbox": [120, 80, 250, 310],
    "embedding": _EMBEDDING,
    "embedding_dim": 512,
}
_EXAMPLES: Final = {
    "classes": {
        "summary": "near a toilet and a mirror",
        "value": {"crops": [{"class": "toilet"}, {"class": "mirror"}]},
    },
    "one picture": {
        "summary": "one picture, by the embeddings of its crops",
        "value": {"crops": [_CROP]},
    },
    "two pictures": {
        "summary": "a robot that turned a quarter to the left between two pictures",
        "value": {
            "views": [{"crops": [_CROP]}, {"dx": 0.0, "dy": 0.0, "dyaw": 1.57, "crops": [_CROP]}]
        },
    },
    "tracked": {
        "summary": "a robot that drove half a metre since its question before",
        "value": {"session": "robot-7", "dx": 0.5, "dy": 0.0, "dyaw": 0.0, "crops": [_CROP]},
    },
}
_OPTIONS: Final = {
    "top": {"type": "integer", "minimum": 1, "maximum": MAX_TOP, "default": 3},
    "method": {"type": "string", "enum": list(get_args(Method)), "default": "joint"},
    "session": {
        "anyOf": [{"type": "string", "minLength": 1, "maxLength": MAX_NAME}, {"type": "null"}],
        "description": "Track the questions of this name.",
    },
}
"""Options of a question that the service reads beside the common fields."""
QUESTION: Final = {
    "requestBody": {
        "required": True,
        "description": "An envelope, a list of detections, or an object with crops or views.",
        "content": {
            "application/json": {"schema": question_schema(_OPTIONS), "examples": _EXAMPLES}
        },
    }
}
"""The body of a question, for ``openapi_extra``."""

_STATE_FORMS: Final[tuple[tuple[str, tuple[str, ...], list[str]], ...]] = (
    ("Near a position", ("x", "y", "radius", "limit"), ["x", "y"]),
    ("All, by pages", ("limit", "cursor"), []),
)
"""Title, properties and required properties of each."""


def state_parameter(parameters: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One parameter for the query ``parameters`` of ``/state``: an object whose properties are
    sent as query parameters of their own. Separate ones could not say which go together."""
    schemas = {each["name"]: each["schema"] for each in parameters}
    return {
        "name": "selection",
        "in": "query",
        "style": "form",
        "explode": True,
        "description": "Each property is a query parameter: `?x=3.4&y=5.2`.",
        "schema": {
            "anyOf": [
                {
                    "title": title,
                    "type": "object",
                    "properties": {name: schemas[name] for name in names},
                    "required": required,
                    "additionalProperties": False,
                }
                for title, names, required in _STATE_FORMS
            ]
        },
        "examples": {
            "near": {"summary": "near a position", "value": {"x": 3.4, "y": 5.2, "radius": 5}},
            "page": {"summary": "the first page", "value": {"limit": 100, "cursor": "0"}},
        },
    }


_PLACE: Final = {
    "place_id": "sim-7-a_p0",
    "centroid_x": 6.77,
    "centroid_y": 5.03,
    "keyframe_count": 445,
}
_POSE: Final = {"x": 3.43, "y": 5.21, "yaw": 0.27, "spread_m": 0.41}
_ANSWER: Final = {
    "places": [
        {
            "place_id": "sim-7-a_p0",
            "score": 1.0,
            "centroid_x": 6.77,
            "centroid_y": 5.03,
            "evidence": [
                {
                    "det_id": "sim-7-a_kf2_d0",
                    "object_id": "obj-5bf2dc3f14b8a1f0",
                    "class_name": "toilet",
                    "similarity": 1.0,
                }
            ],
        }
    ],
    "pose": _POSE,
    "confidence": 0.62,
    "known": 0.97,
    "known_spread": 0.04,
    "unknown": False,
    "thin": None,
}
_PLACES: Final = {"places": [_PLACE], "next": None}

METRICS: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "Questions, their times and results, and the database's state",
        "content": {"text/plain": {"schema": {"type": "string"}}},
    }
}


CROP: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "The JPEG",
        "content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}},
    },
    304: {"description": "The client has it already"},
}


EXAMPLES: Final = (
    ("/relocalize", "post", _ANSWER),
    ("/state/{what}", "get", _PLACES),
    ("/health", "get", {"status": "ok"}),
)
"""Path, method and an example of the answer."""

_RETRY_AFTER: Final = {
    "Retry-After": {
        "description": "Seconds to wait before asking again; with the kind too_much.",
        "schema": {"type": "string"},
    }
}
_TOKEN: Final = {
    "WWW-Authenticate": {"description": "The scheme of the token.", "schema": {"type": "string"}}
}
_ALLOW: Final = {"Allow": {"description": "The methods of the path.", "schema": {"type": "string"}}}
_EVERYWHERE: Final[tuple[tuple[int, str, dict[str, Any]], ...]] = (
    (400, "The request is wrong, or it does not fit the map", {}),
    (401, "The token is missing or wrong", _TOKEN),
    (403, "The Origin header names another site, which --cors does not allow", {}),
    (404, "No such path, or the map does not have what is asked for", {}),
    (405, "The path does not have this method", _ALLOW),
    (408, "The request did not end within 10 seconds", {}),
    (411, "The body came in chunks; send a Content-Length", {}),
    (421, "The Host header does not name this service", {}),
    (431, "The head of the request is too long", {}),
    (500, "A fault of the service, which it logs", {}),
)
_ASKING: Final[tuple[tuple[int, str, dict[str, Any]], ...]] = (
    (429, "More questions a second than --rate", _RETRY_AFTER),
    (503, "The database cannot be queried now, or too many questions wait", _RETRY_AFTER),
)


def refusals(*, asking: bool = False) -> dict[int | str, dict[str, Any]]:
    """The refusals of a path; ``asking`` for a path that queries the database."""
    known = _EVERYWHERE + (_ASKING if asking else ())
    return {
        status: {"model": RefusalShape, "description": text}
        | ({"headers": headers} if headers else {})
        for status, text, headers in sorted(known)
    }


_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>mapfold: HTTP interface</title>
<link rel="stylesheet" href="/docs/swagger-ui.css">
<link rel="icon" href="data:,">
</head>
<body>
<div id="swagger-ui"></div>
<noscript>This page needs JavaScript; <a href="/openapi.json">/openapi.json</a> does not.</noscript>
<script src="/docs/swagger-ui-bundle.js"></script>
<script src="/docs/start.js"></script>
</body>
</html>
"""
_MISSING: Final = (
    "Swagger UI is not installed here; pip install 'mapfold[serve]'. The description is at"
    " /openapi.json.\n"
)
_START: Final = (
    "SwaggerUIBundle({url: '/openapi.json', dom_id: '#swagger-ui', deepLinking: true,"
    " validatorUrl: null, presets: [SwaggerUIBundle.presets.apis]});\n"
)


def add_docs(app: FastAPI, dependencies: Sequence[Any]) -> None:
    """Add the page and its files to ``app``, outside its description, with ``dependencies``."""
    router = APIRouter(include_in_schema=False, dependencies=dependencies)

    @router.get("/docs")
    async def docs() -> Response:
        if find_spec("fastapi_offline") is None:
            return Response(_MISSING, media_type="text/plain")
        return Response(_PAGE, media_type="text/html", headers={"Content-Security-Policy": _POLICY})

    @router.get("/docs/start.js")
    async def start() -> Response:
        return Response(_START, media_type="text/javascript")

    @router.get("/docs/swagger-ui-bundle.js")
    async def script() -> Response:
        return _file("swagger-ui-bundle.js", "text/javascript")

    @router.get("/docs/swagger-ui.css")
    async def style() -> Response:
        return _file("swagger-ui.css", "text/css")

    app.include_router(router)


def _file(name: str, media_type: str) -> Response:
    headers = {"Cache-Control": "max-age=3600"}
    return Response(_content(name), media_type=media_type, headers=headers)


@cache
def _content(name: str) -> bytes:
    import fastapi_offline

    return files(fastapi_offline).joinpath("static", name).read_bytes()
