"""A Zenoh router inside this process, so that nothing else need be installed."""

from types import TracebackType
from typing import Self

from ._zenoh import ZenohOptions, open_session


class Router:
    """A running router: ``with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router: …``.

    ``endpoints`` is where it listens; port 0 asks the system for a free port, and stands there
    with the number it got. Raises TransportError if it cannot listen.
    """

    def __init__(self, options: ZenohOptions) -> None:
        self._session = open_session(options, mode="router")
        self.endpoints = tuple(self._session.locators)

    def close(self) -> None:
        """Stop routing and free the port. May be called twice."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()
