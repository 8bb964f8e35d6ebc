"""A recorder's numbers for Prometheus, over HTTP.

The one door to prometheus_client. The numbers are read when somebody scrapes, so metrics cost the
recording nothing.

The HTTP server behind ``--metrics``: connections that are held open cost the recorder nothing.

Each request has a thread, and a connection that waits would keep it, and its file descriptor, for
ever. Here a silent one is closed after ``SILENT_S``, and beyond ``MAX_CONNECTIONS`` the oldest
gives way.
"""

import contextlib
import shutil
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from .errors import TransportError
from .recorder import RecorderReport

SILENT_S: Final = 5.0
MAX_CONNECTIONS: Final = 16


class _Handler(WSGIRequestHandler):
    timeout = SILENT_S

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  the base class's name
        """Log nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    request_queue_size = 64

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._open: dict[Any, None] = {}
        self._lock = threading.Lock()

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._open[request] = None
            if len(self._open) > MAX_CONNECTIONS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                with contextlib.suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # who asked is gone: nobody is left to tell
            super().handle_error(request, client_address)


class _Server6(_Server):
    address_family = socket.AF_INET6


@contextlib.contextmanager
def serving_wsgi(host: str, port: int, application: Callable[..., Any]) -> Iterator[int]:
    """Serve in a thread for the length of a ``with`` block; yields the port. Raises OSError."""
    kind = _Server6 if ":" in host else _Server
    with make_server(host.strip("[]"), port, application, kind, _Handler) as server:
        thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


_COUNTERS: Final = (
    ("recorded", "Envelopes synced to the log."),
    ("rejected", "Payloads refused and kept under mapfold/rejected."),
    ("queue_full", "Messages lost because the queue was full."),
    ("too_large", "Messages lost because they were too large to be kept as rejected."),
    ("transport_missed", "Messages that advanced publishers sent and that never came."),
    ("lost_from_log", "Recorded events lost with a segment file that was taken away or cut short."),
)
_GAUGES: Final = (
    ("missing", "Keyframes the log's runs lack now."),
    ("queue_depth", "Messages that wait for the log's writer."),
    ("queue_size", "How many may wait."),
    ("next_offset", "Events in the log."),
    ("unsealed", "Finished segments that wait to be sealed."),
)


class _RecorderCollector(Collector):
    def __init__(self, report: Callable[[], RecorderReport], log: Path) -> None:
        self._report = report
        self._log = log

    def collect(self) -> Iterator[Metric]:
        report = self._report()
        for name, text in _COUNTERS:
            yield CounterMetricFamily(f"mapfold_recorder_{name}", text, getattr(report, name))
        for name, text in _GAUGES:
            yield GaugeMetricFamily(f"mapfold_recorder_{name}", text, getattr(report, name))
        failing = report.sealing_error is not None
        yield GaugeMetricFamily("mapfold_recorder_sealing_failing", "1 while it fails.", failing)
        free = shutil.disk_usage(self._log).free
        yield GaugeMetricFamily("mapfold_recorder_disk_free_bytes", "Room where the log is.", free)


@contextmanager
def serving_metrics(
    address: tuple[str, int], report: Callable[[], RecorderReport], log: Path
) -> Iterator[int]:
    """Serve ``/metrics`` for the length of a ``with`` block; yields the port, also for port 0.

    Raises TransportError when the address cannot be listened on.
    """
    with _serving(address, _RecorderCollector(report, log)) as port:
        yield port


@dataclass(frozen=True, slots=True)
class Number:
    """One number to serve: a counter if it only grows, else a gauge; ``labels`` tell apart."""

    name: str
    text: str
    value: float
    counter: bool = False
    labels: tuple[tuple[str, str], ...] = ()


class _NumbersCollector(Collector):
    def __init__(self, numbers: Callable[[], Iterable[Number]]) -> None:
        self._numbers = numbers

    def collect(self) -> Iterator[Metric]:
        for number in self._numbers():
            family = CounterMetricFamily if number.counter else GaugeMetricFamily
            metric = family(number.name, number.text, labels=[name for name, _ in number.labels])
            metric.add_metric([value for _, value in number.labels], number.value)
            yield metric


@contextmanager
def serving_numbers(
    address: tuple[str, int], numbers: Callable[[], Iterable[Number]]
) -> Iterator[int]:
    """Serve any other numbers in the same way; ``numbers`` is called at each scrape."""
    with _serving(address, _NumbersCollector(numbers)) as port:
        yield port


@contextmanager
def _serving(address: tuple[str, int], collector: Collector) -> Iterator[int]:
    registry = CollectorRegistry()
    registry.register(collector)
    host, port = address
    with ExitStack() as stack:
        try:
            bound = stack.enter_context(serving_wsgi(host, port, make_wsgi_app(registry)))
        except OSError as error:
            raise TransportError(
                f"cannot serve metrics on {host}:{port}: {error.strerror or error}; "
                "choose another with --metrics"
            ) from None
        yield bound
