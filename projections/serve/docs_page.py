"""``/docs``: Swagger UI for ``/openapi.json``, with nothing loaded from other servers.

The files of Swagger UI are those of the package fastapi-offline, which only this module imports. By
its Content-Security-Policy the page may load from and connect to this server only; its own script
is a file too, because inline scripts are not allowed.
"""

from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from typing import Final

from fastapi import FastAPI
from fastapi.responses import Response

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


def add_docs(app: FastAPI) -> None:
    """Add the page and its files to ``app``, outside its description."""

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        if find_spec("fastapi_offline") is None:
            return Response(_MISSING, media_type="text/plain")
        return Response(_PAGE, media_type="text/html", headers={"Content-Security-Policy": _POLICY})

    @app.get("/docs/start.js", include_in_schema=False)
    async def start() -> Response:
        return Response(_START, media_type="text/javascript")

    @app.get("/docs/swagger-ui-bundle.js", include_in_schema=False)
    async def script() -> Response:
        return _file("swagger-ui-bundle.js", "text/javascript")

    @app.get("/docs/swagger-ui.css", include_in_schema=False)
    async def style() -> Response:
        return _file("swagger-ui.css", "text/css")


def _file(name: str, media_type: str) -> Response:
    headers = {"Cache-Control": "max-age=3600"}
    return Response(_content(name), media_type=media_type, headers=headers)


@cache
def _content(name: str) -> bytes:
    import fastapi_offline

    return files(fastapi_offline).joinpath("static", name).read_bytes()
