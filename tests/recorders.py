"""A recorder at work beside a test."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from eventsrc.recorder import Recorder, RecorderReport
from tests.fixtures_zenoh import DEADLINE_S


class Running:
    """A recorder at work in this process; `finish` stops it and returns its report."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._seen = threading.Condition()
        self._latest = recorder.report()
        self._stop = threading.Event()
        self._thread = ThreadPoolExecutor(1)
        self._done = self._thread.submit(recorder.run, self._stop, every_s=0.01, watch=self._watch)

    def _watch(self, report: RecorderReport) -> None:
        with self._seen:
            self._latest = report
            self._seen.notify_all()

    def wait_until(self, true: Callable[[RecorderReport], bool]) -> None:
        with self._seen:
            assert self._seen.wait_for(lambda: true(self._latest), DEADLINE_S), self._latest

    def finish(self) -> RecorderReport:
        self._stop.set()
        self._thread.shutdown()
        return self._done.result()
