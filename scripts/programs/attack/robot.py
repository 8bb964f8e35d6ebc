"""An honest robot that publishes through its spool and notes what was acknowledged."""

import json
import threading
from pathlib import Path

from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import ZenohOptions
from tests.support.envelopes import envelope

from .oracle import Oracle, digest


class Robot:
    """Publishes ``per_second`` envelopes in a thread until `finish`; a context manager.

    An envelope that has left the spool is acknowledged: no other copy of it need exist any more.
    """

    def __init__(
        self, endpoint: str, spool: Path, oracle: Oracle, *, run_id: str, per_second: float
    ) -> None:
        self._oracle, self._run_id, self._pause_s = oracle, run_id, 1 / per_second
        self._name = spool.name
        options = ZenohOptions(connect=(endpoint,))
        self.publisher = EnvelopePublisher(options, spool, resend_after_s=0.5)
        self.sent: set[bytes] = set()
        """Digests of all that was published."""
        self._publishing = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish)

    def start(self) -> None:
        """Begin to publish."""
        self._thread.start()

    def publish(self) -> None:
        """Publish one more. Robots of one run id differ in what they say."""
        with self._publishing:
            number = len(self.sent)
            document = envelope(number, run_id=self._run_id, robot=self._name, note="x" * 2_000)
            payload = json.dumps(document).encode()
            self._oracle.sent(payload)
            self.sent.add(digest(payload))
            self.publisher.publish(payload)

    def note_acknowledged(self) -> None:
        """Tell the oracle what has left the spool. Call it when no recorder runs."""
        # What is counted as published and not in the spool yet would look acknowledged.
        with self._publishing:
            waiting = {digest(s.payload) for s in self.publisher._spool.after(0, 2**62)}
            self._oracle.acknowledged(self.sent - waiting)

    def finish(self, timeout_s: float) -> bool:
        """Stop publishing; whether everything was acknowledged in time."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        return self.publisher.flush(timeout_s)

    def _publish(self) -> None:
        while not self._stop.wait(self._pause_s):
            self.publish()

    def __enter__(self) -> "Robot":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.publisher.close()
