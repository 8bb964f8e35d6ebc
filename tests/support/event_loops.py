"""Run a coroutine to its end in a thread of its own.

`asyncio.run` fails in a thread whose loop runs, and tests of the page in a browser (playwright)
leave one running in the main thread of their process.
"""

import asyncio
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")


def run_apart(coroutine: Coroutine[Any, Any, T]) -> T:
    """What ``coroutine`` returns or raises."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, coroutine).result()  # noqa: TID251
