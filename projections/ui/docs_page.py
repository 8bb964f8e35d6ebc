"""The description of the interface as a page of plain HTML.

FastAPI's own ``/docs`` loads its code from another host.
"""

from collections.abc import Mapping
from html import escape
from typing import Any


def docs_page(schema: Mapping[str, Any]) -> bytes:
    """A table of the questions of an OpenAPI ``schema``."""
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
