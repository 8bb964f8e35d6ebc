"""Metrics of the service for ``/metrics``: questions by transport, kind and result, their times,
HTTP responses by status, and the state of queue, sessions and database."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from typing import Any, Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from eventsrc.base.errors import MapfoldError
from eventsrc.record.metrics import Instruments, MetricValue

from .answering import Answerer, refusal
from .fair_queue import FairQueue

_BUCKETS_S: Final = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0)
_QUESTIONS: Final = frozenset(
    {
        *("relocalize", "places", "objects", "health"),
        *("find", "room", "path", "object", "goal", "changes", "crop"),
    }
)


class ServiceMetrics:
    """The service's metrics; for any thread."""

    def __init__(self, answerer: Answerer, queue: FairQueue) -> None:
        self._answerer, self._queue = answerer, queue
        instruments = Instruments(self._values)
        self._count = instruments.counter(
            "mapfold_serve_questions",
            "Questions answered or refused, by transport, question and result.",
            ("transport", "question", "result"),
        )
        self._took = instruments.histogram(
            "mapfold_serve_question_seconds",
            "From the receipt of a question to its answer or refusal, waiting included.",
            ("transport", "question"),
            _BUCKETS_S,
        )
        self.count_status: Callable[[str], None] = instruments.counter(
            "mapfold_serve_http_responses", "HTTP responses by status.", ("status",)
        )
        self.text = instruments.text

    def watch(self, transport: str, question: str, answer: "Future[Any]") -> None:
        """Count a question when its ``answer`` is done; called when the question arrives."""
        began = time.perf_counter()

        def done(answer: "Future[Any]") -> None:
            self.asked(transport, question, time.perf_counter() - began, _result(answer))

        answer.add_done_callback(done)

    def asked(self, transport: str, question: str, seconds: float, result: str) -> None:
        """Count a question. ``result`` is ``answered`` or the kind of its error."""
        name = question if question in _QUESTIONS else "other"
        self._count(transport, name, result)
        self._took(seconds, transport, name)

    def _values(self) -> Iterator[MetricValue]:
        yield MetricValue(
            "mapfold_serve_database_up",
            "1 unless the last question or health probe failed because of the database.",
            self._answerer.database_up,
        )
        yield MetricValue(
            "mapfold_serve_queue_depth", "Questions that wait for a worker.", len(self._queue)
        )
        yield MetricValue(
            "mapfold_serve_queue_size", "Most questions that may wait.", self._queue.capacity
        )
        yield MetricValue(
            "mapfold_serve_sessions", "Robots that are tracked.", self._answerer.session_count
        )


class CountedResponses:
    """ASGI middleware that counts the responses by status, also those of the access control."""

    def __init__(self, app: ASGIApp, metrics: ServiceMetrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def send_counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._metrics.count_status(str(message["status"]))
            await send(message)

        await self._app(scope, receive, send_counted)


def _result(answer: "Future[Any]") -> str:
    try:
        error = answer.exception()
    except CancelledError:
        return "cancelled"
    if error is None:
        return "answered"
    known = error if isinstance(error, MapfoldError) else MapfoldError()
    return str(refusal(known)[1]["error"]["kind"])
