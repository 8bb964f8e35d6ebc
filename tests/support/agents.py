"""Ask `mapfold mcp` with the official client."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx2
from mcp.client import Client
from mcp.client.stdio import StdioServerParameters, stdio_client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import CallToolResult, TextContent

from tests.support.commands import PROGRAM
from tests.support.event_loops import run_apart

DEADLINE_S = 60.0
T = TypeVar("T")


def asked(connected: Any, ask: Callable[[Client], Awaitable[T]]) -> T:
    """What ``ask`` returns for a client of a server, a URL or a transport."""

    async def run() -> T:
        async with asyncio.timeout(DEADLINE_S), Client(connected) as client:
            return await ask(client)

    return run_apart(run())


def over_stdio(*words: str | Path) -> Any:
    """A transport to ``mapfold mcp`` with these words, in a process of its own."""
    return stdio_client(StdioServerParameters(command=str(PROGRAM), args=["mcp", *map(str, words)]))


@asynccontextmanager
async def with_token(url: str, token: str) -> AsyncIterator[Any]:
    """A transport over HTTP that sends a token."""
    headers = {"Authorization": f"Bearer {token}"}
    async with (
        httpx2.AsyncClient(headers=headers) as client,
        streamable_http_client(url, http_client=client) as streams,
    ):
        yield streams


def tool(connected: Any, name: str, /, **arguments: Any) -> Any:
    """The document that a tool answers."""
    found = called(connected, name, arguments)
    assert not found.is_error, text_of(found)
    return found.structured_content


def called(connected: Any, name: str, arguments: dict[str, Any]) -> CallToolResult:
    """The answer of a tool, also an error."""
    return asked(connected, lambda client: client.call_tool(name, arguments))


def text_of(found: CallToolResult) -> str:
    """The text of an answer."""
    assert isinstance(found.content[0], TextContent)
    return found.content[0].text
