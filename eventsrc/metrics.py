"""A recorder's numbers for Prometheus, over HTTP.

The one door to prometheus_client. The numbers are read when somebody scrapes, so metrics cost the
recording nothing.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from .errors import TransportError
from .recorder import RecorderReport

_COUNTERS: Final = (
    ("recorded", "Envelopes synced to the log."),
    ("rejected", "Payloads refused and kept under mapfold/rejected."),
    ("queue_full", "Messages lost because the queue was full."),
    ("transport_missed", "Messages that advanced publishers sent and that never came."),
)
_GAUGES: Final = (
    ("missing", "Keyframes the log's runs lack now."),
    ("queue_depth", "Messages that wait for the log's writer."),
    ("queue_size", "How many may wait."),
    ("next_offset", "Events in the log."),
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
        free = shutil.disk_usage(self._log).free
        yield GaugeMetricFamily("mapfold_recorder_disk_free_bytes", "Room where the log is.", free)


@contextmanager
def serving_metrics(
    address: tuple[str, int], report: Callable[[], RecorderReport], log: Path
) -> Iterator[int]:
    """Serve ``/metrics`` for the length of a ``with`` block; yields the port, also for port 0.

    Raises TransportError when the address cannot be listened on.
    """
    registry = CollectorRegistry()
    registry.register(_RecorderCollector(report, log))
    host, port = address
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise TransportError(
            f"cannot serve metrics on {host}:{port}: {error.strerror or error}; "
            "choose another with --metrics"
        ) from None
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
