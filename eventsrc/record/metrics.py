"""Metrics for Prometheus over HTTP (`--metrics`): the recorder's, and other programs' values; also
as text, for programs that have an HTTP server (`Instruments`).

Only this module imports prometheus_client. Values are read at each scrape, so recording does no
extra work. Each connection has a thread and a file descriptor. So a silent one is closed after
``SILENT_S``, and beyond ``MAX_CONNECTIONS`` the oldest is closed.
"""

import shutil
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Histogram,
    disable_created_metrics,
    generate_latest,
    make_wsgi_app,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from eventsrc.base.errors import TransportError

if TYPE_CHECKING:
    from .recorder.writer_thread import RecorderReport

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
                with suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # the client has gone
            super().handle_error(request, client_address)


class _Server6(_Server):
    address_family = socket.AF_INET6


@contextmanager
def _serving_wsgi(host: str, port: int, application: Callable[..., Any]) -> Iterator[int]:
    """Serve in a thread within a ``with`` block; yields the port. Raises OSError."""
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
    ("crops", "JPEGs of detections synced to the log."),
    ("messages", "Messages of ROS synced to the log."),
    ("rejected", "Payloads refused and kept under mapfold/rejected."),
    ("queue_full", "Messages lost because the queue was full."),
    ("transport_missed", "Messages of advanced publishers that were sent but not received."),
    ("lost_from_log", "Recorded events lost with a segment file that was taken away or cut short."),
)
_OF_ROS: Final = (
    ("untyped", "Messages of ROS kept without a schema: no bridge declared their type."),
    ("unknown_keys", "Messages left out because their keys are no topics of ROS."),
)
_STREAM_COUNTERS: Final = (
    ("keyframes", "Keyframes made of ROS detections."),
    ("detections", "Detections in these keyframes."),
    ("with_embedding", "Detections with an embedding."),
    ("unclassified", "Detections without a class."),
    ("without_pose", "Keyframes without a pose."),
    ("without_camera_frame", "Keyframes with the pose of the base, not of the camera."),
    ("without_base_frame", "Keyframes with the heading of the camera, not of the base."),
    ("without_camera", "Keyframes without the camera's field of view."),
    ("without_covariance", "Keyframes with a pose, but without its error."),
)
"""Counters of each topic of ROS detections."""
_GAUGES: Final = (
    ("missing", "Keyframes missing from the log's runs."),
    ("queue_depth", "Messages that wait for the log's writer."),
    ("queue_size", "Bound of queue_depth."),
    ("next_offset", "Events in the log."),
    ("unsealed", "Finished segments that wait to be sealed."),
)


class _Collector(Collector):
    def __init__(self, collect: Callable[[], Iterator[Metric]]) -> None:
        self._collect = collect

    def collect(self) -> Iterator[Metric]:
        return self._collect()


def _recorder_metrics(report: "RecorderReport", log: Path) -> Iterator[Metric]:
    for name, text in _COUNTERS:
        yield CounterMetricFamily(f"mapfold_recorder_{name}", text, getattr(report, name))
    for name, text in _GAUGES:
        yield GaugeMetricFamily(f"mapfold_recorder_{name}", text, getattr(report, name))
    if report.streams:
        yield from _ros_metrics(report)
    failing = report.sealing_error is not None
    yield GaugeMetricFamily("mapfold_recorder_sealing_failing", "1 if sealing fails.", failing)
    free = shutil.disk_usage(log).free
    yield GaugeMetricFamily("mapfold_recorder_disk_free_bytes", "Free space for the log.", free)


def _ros_metrics(report: "RecorderReport") -> Iterator[Metric]:
    for name, text in _OF_ROS:
        yield CounterMetricFamily(f"mapfold_recorder_ros_{name}", text, getattr(report, name))
    unread = CounterMetricFamily(
        "mapfold_recorder_ros_unread", "Messages kept that cannot be read.", labels=["topic"]
    )
    for topic, count, _ in report.unread:
        unread.add_metric([topic], count)
    yield unread
    for name, text in _STREAM_COUNTERS:
        family = CounterMetricFamily(f"mapfold_recorder_ros_{name}", text, labels=["topic"])
        for topic, counts in report.streams:
            family.add_metric([topic], getattr(counts, name))
        yield family


def serving_metrics(
    address: tuple[str, int], report: "Callable[[], RecorderReport]", log: Path
) -> AbstractContextManager[int]:
    """Serve ``/metrics`` within a ``with`` block; yields the port, also for port 0.

    Raises TransportError when the address cannot be listened on.
    """
    return _serving(address, lambda: _recorder_metrics(report(), log))


@dataclass(frozen=True, slots=True)
class MetricValue:
    """One value to serve: a counter if it only grows, else a gauge. ``text`` is its help."""

    name: str
    text: str
    value: float
    counter: bool = False
    labels: tuple[tuple[str, str], ...] = ()


def _metrics_of(values: Iterable[MetricValue]) -> Iterator[Metric]:
    for value in values:
        family = CounterMetricFamily if value.counter else GaugeMetricFamily
        metric = family(value.name, value.text, labels=[name for name, _ in value.labels])
        metric.add_metric([text for _, text in value.labels], value.value)
        yield metric


class Instruments:
    """A program's own counters and histograms, beside ``values``, which are read at each scrape.
    Thread-safe."""

    def __init__(self, values: Callable[[], Iterable[MetricValue]]) -> None:
        # Without this every label has a line more, with the time when it was first used.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self._registry = CollectorRegistry()
        self._registry.register(_Collector(lambda: _metrics_of(values())))

    def counter(self, name: str, text: str, labels: Sequence[str]) -> Callable[..., None]:
        """A counter; returns the function that counts one up, called with the labels' values."""
        counter = Counter(name, text, labels, registry=self._registry)
        return lambda *of: counter.labels(*of).inc()

    def histogram(
        self, name: str, text: str, labels: Sequence[str], buckets: Sequence[float]
    ) -> Callable[..., None]:
        """A histogram; returns the function that takes a value and the labels' values."""
        histogram = Histogram(name, text, labels, buckets=buckets, registry=self._registry)
        return lambda value, *of: histogram.labels(*of).observe(value)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self._registry)


METRICS_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
"""The content type of `Instruments.text`."""


def serving_values(
    address: tuple[str, int], values: Callable[[], Iterable[MetricValue]]
) -> AbstractContextManager[int]:
    """`serving_metrics` with the values that ``values`` returns at each scrape."""
    return _serving(address, lambda: _metrics_of(values()))


@contextmanager
def _serving(address: tuple[str, int], collect: Callable[[], Iterator[Metric]]) -> Iterator[int]:
    registry = CollectorRegistry()
    registry.register(_Collector(collect))
    host, port = address
    with ExitStack() as stack:
        try:
            bound = stack.enter_context(_serving_wsgi(host, port, make_wsgi_app(registry)))
        except OSError as error:
            raise TransportError(
                f"cannot serve metrics on {host}:{port}: {error.strerror or error}; "
                "choose another address with --metrics"
            ) from None
        yield bound
