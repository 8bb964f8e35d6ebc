"""Publish envelopes from a robot, with none lost while the link or the recorder is away.

* `EnvelopePublisher.publish` writes the envelope into the spool and returns; it never waits for
  the network. One thread sends (`Sender`), in the order of publishing.
* An envelope leaves the spool when a recorder's ack names its bytes; an ack names what is synced in
  a log. Until then it is sent again, so it may arrive more than once; the fold counts the first.
* `publish` raises for an envelope that no recorder would accept: it validates as recorders do
  (`eventsrc.envelope.ingest`). A recorder may have narrower rules (`--max-payload`) or older ones.
  An envelope that it refuses, with the bytes and the reason in its log, is quarantined in the spool
  and no longer sent, since it would block everything behind it: see `EnvelopePublisher.refused`.

The sending thread:

* Nothing is sent while there is no subscriber; the spool grows. When a subscriber appears, sending
  starts again at the oldest envelope that is not acknowledged.
* At most ``window`` envelopes are in transit, so that a long spool does not flood the recorder's
  queue.
* When no ack comes for the resend time, the oldest envelope is sent again, alone, as a probe;
  unanswered probes back off exponentially. When a probe is answered and the ack does not cover the
  rest, everything from the oldest on is sent again.
* Acks come in the order of sending. When the oldest envelope waits for the resend time while
  younger ones are acknowledged, it was lost, and everything from it on is sent again; otherwise
  lost envelopes would fill the window for good. The same holds when the last subscriber has left
  and another has come, however soon.
* Progress (`Sent`) is published at most twice a second and at the end.
* Acks and refusals arrive on Zenoh's thread, which only queues them. They are applied whether or
  not there is a subscriber: a recorder sends its last acks just after it has unsubscribed.
"""

import contextlib
import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Self

from pydantic import ValidationError

from eventsrc.base.errors import InvalidEnvelope, MisuseError, SpoolError, TransportError
from eventsrc.envelope.ingest import Rejected, ingest
from eventsrc.envelope.model import RunId
from eventsrc.envelope.system_events import RESERVED_PREFIX, is_system_key
from eventsrc.record.transport.config import check_key
from eventsrc.record.transport.session import (
    Publisher,
    Received,
    Session,
    ZenohOptions,
    check_options,
    open_session,
)

from .acks import Ack, Refusals, Sent, ack_key, refusal_key, sent_key
from .spool import DEFAULT_SPOOL_BYTES, Refused, Spool, Spooled

WINDOW: Final = 1_024
"""With a group commit every 50 ms this allows about 20,000 envelopes a second."""
RESEND_AFTER_S: Final = 2.0
_MAX_PAUSE_S: Final = 30.0
_AFTER_PROBE_S: Final = 0.5
"""After an answered probe: how long the other acks may take, which come in groups."""
_RECONNECT_S: Final = 1.0
_PROGRESS_S: Final = 0.5
_MAX_ANSWER_BYTES: Final = 4 * 1024 * 1024
"""No recorder sends a larger ack or refusal."""
_POLL_S: Final = 0.25
"""Interval of checks for a subscriber; also the longest delay of `Sender.stop`."""


class EnvelopePublisher:
    """Publishes one robot's envelopes under ``key``; a context manager, usable from any thread.

    The constructor opens the spool and begins to send what an earlier process left in it. It raises
    SpoolError if the spool cannot be used, and MisuseError if the key is reserved or malformed, an
    endpoint is malformed or the configuration file invalid. It does not raise when no router
    answers: the sending thread tries until one does.
    """

    def __init__(
        self,
        options: ZenohOptions,
        spool: Path,
        key: str = "tb/detections",
        *,
        max_spool_bytes: int = DEFAULT_SPOOL_BYTES,
        window: int = WINDOW,
        resend_after_s: float = RESEND_AFTER_S,
    ) -> None:
        if is_system_key(key):
            raise MisuseError(
                f"key {key!r}: every recorder refuses envelopes under {RESERVED_PREFIX}; "
                "choose another"
            )
        check_key(key, "key")
        check_options(options)
        self._spool = Spool(spool, max_spool_bytes)
        self._sender = Sender(options, key, self._spool, window, resend_after_s)
        run = self._sender.run
        self._thread = threading.Thread(target=run, name="envelope-sender", daemon=True)
        self._thread.start()
        self._waiting: int | None = None

    def publish(self, envelope: Mapping[str, Any] | bytes) -> None:
        """Spool one envelope: a dictionary, or its JSON as bytes, which are sent unchanged.

        Raises InvalidEnvelope with the reason a recorder would give, SpoolFull when the spool has
        no room, SpoolError when the spool is closed or its disk fails, TransportError when the
        sending thread has died.
        """
        payload = envelope if isinstance(envelope, bytes) else _encode(envelope)
        outcome = ingest(payload)
        if isinstance(outcome, Rejected):
            raise InvalidEnvelope(f"envelope not published: {outcome.reason}")
        self._sender.raise_failure()
        self._spool.add(outcome.envelope.run_id, outcome.envelope.keyframe_id, payload)
        self._sender.wake()

    @property
    def unacknowledged(self) -> int:
        """How many envelopes wait for a recorder's acknowledgement."""
        return len(self._spool)

    @property
    def refused_count(self) -> int:
        """How many envelopes a recorder has refused; they are quarantined in the spool."""
        return self._spool.refused_count

    def refused(self, limit: int = 100) -> list[Refused]:
        """The oldest refused envelopes, each with the refusing recorder's log and its reason."""
        return self._spool.refused(limit)

    def retry_refused(self) -> int:
        """Send the refused envelopes again, for a recorder that was fixed; returns how many.

        Those whose bytes were dropped for new envelopes stay `refused`; the log named there has
        them.
        """
        retried = self._spool.retry_refused()
        self._sender.wake()
        return retried

    def discard_refused(self) -> int:
        """Drop the refused envelopes; returns how many."""
        return self._spool.discard_refused()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything published is acknowledged or refused.

        True when all of it is acknowledged; False on a timeout or when any is `refused`.
        """
        return self._sender.wait_until_answered(timeout_s) and not self.refused_count

    def close(self, timeout_s: float = 0.0) -> int:
        """`flush`, then stop. Returns how many envelopes wait in the spool for the next process."""
        if self._waiting is None:
            if timeout_s > 0:
                self.flush(timeout_s)
            self._sender.stop()
            self._thread.join()
            self._waiting = len(self._spool)
            self._spool.close()
        return self._waiting

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _encode(envelope: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(envelope, ensure_ascii=False, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InvalidEnvelope(f"envelope not published: not JSON: {error}") from None


class Sender:
    """`run` is the body of the sending thread; the other methods are for other threads."""

    def __init__(
        self,
        options: ZenohOptions,
        key: str,
        spool: Spool,
        window: int,
        resend_after_s: float,
    ) -> None:
        self._options = options
        self._key = key
        self._spool = spool
        self._window = window
        self._resend_after_s = resend_after_s
        self._changed = threading.Condition()
        self._answers: deque[Ack | Refusals] = deque()
        self._sent = 0  # the highest seq that was ever sent
        self._unreported: dict[RunId, int] = {}
        """By run: the highest keyframe sent, if its progress is not published yet."""
        self._progress_due_s = 0.0
        self._woken = self._stopping = False
        self._failure: TransportError | None = None

    def wake(self) -> None:
        """Make the sending thread look for new envelopes in the spool."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Make `run` return soon."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def raise_failure(self) -> None:
        """Raise the error that ended the thread, if one did."""
        if self._failure is not None:
            raise self._failure

    def wait_until_answered(self, timeout_s: float) -> bool:
        """Wait until the spool is empty; False on a timeout."""
        with self._changed:
            self._changed.wait_for(lambda: not len(self._spool) or self._failure, timeout_s)
        self.raise_failure()
        return not len(self._spool)

    def run(self) -> None:
        """Connect, send, and connect again, until stopped or the spool fails."""
        try:
            while not self._stopping:
                self._connect_and_send()
        finally:
            if not self._stopping:  # an unexpected error: `publish` must raise from now on
                self._failure = TransportError(
                    f"key {self._key!r}: the sending thread has died, see stderr; what is "
                    "spooled stays. Close this publisher and open another"
                )
                self.stop()

    def _connect_and_send(self) -> None:
        try:
            with open_session(self._options, mode=self._options.mode) as session:
                self._run_session(session)
        except SpoolError as failure:
            self._failure = failure
            self.stop()
        except (TransportError, MisuseError):  # no router, or the configuration file is gone
            with self._changed:
                self._changed.wait_for(lambda: self._stopping, _RECONNECT_S)

    def _run_session(self, session: Session) -> None:
        publisher, progress = session.publisher(self._key), session.publisher(sent_key(self._key))
        session.subscribe(refusal_key(self._key), lambda message: self._queue(message, Refusals))
        subscribed: set[str] = set()
        try:
            while not self._stopping:
                self._apply_answers()
                if publisher.wait_for_subscriber(_POLL_S):
                    self._send_while_subscribed(session, publisher, progress, subscribed)
        finally:
            with contextlib.suppress(TransportError):  # the session may be gone
                self._report_progress(progress)
            self._apply_answers()

    def _send_while_subscribed(
        self, session: Session, publisher: Publisher, progress: Publisher, subscribed: set[str]
    ) -> None:
        """Send and apply acks until the subscriber has left; ``subscribed`` are the runs whose acks
        the session has subscribed to."""
        cursor, oldest = 0, self._spool.oldest()
        departures = publisher.departures
        timer = ResendTimer(self._resend_after_s)
        while not self._stopping and publisher.has_subscriber:
            if publisher.departures != departures:
                return
            if self._apply_answers():
                before, oldest = oldest, self._spool.oldest()
                timer.on_oldest_answered() if oldest != before else timer.on_younger_answered()
            if self._unreported and time.monotonic() >= self._progress_due_s:
                self._report_progress(progress)
            in_transit = self._spool.waiting_up_to(cursor)
            batch = self._spool.after(cursor, self._window - in_transit)
            if batch:
                self._subscribe_to_acks(session, batch, subscribed)
                cursor = self._send(publisher, batch)
                if not in_transit:
                    timer.restart()
            elif in_transit and timer.expired():
                if timer.recorder_answers:
                    cursor = 0
                    timer.restart()
                else:
                    self._send(publisher, self._spool.after(0, 1))
                    timer.on_probe_sent()
            else:
                self._wait(_POLL_S)

    def _subscribe_to_acks(
        self, session: Session, batch: list[Spooled], subscribed: set[str]
    ) -> None:
        """Subscribe to the acks of every run in ``batch``, which is not sent yet."""
        new = {spooled.run_id for spooled in batch} - subscribed
        for run_id in sorted(new):
            session.subscribe(ack_key(run_id), lambda message: self._queue(message, Ack))
        if new:
            session.confirm()
            subscribed |= new

    def _send(self, publisher: Publisher, batch: list[Spooled]) -> int:
        """Send ``batch``; returns its last seq, 0 if it is empty."""
        for spooled in batch:
            publisher.put(spooled.payload)
            self._sent = max(self._sent, spooled.seq)
            known = self._unreported.get(spooled.run_id, spooled.keyframe_id)
            self._unreported[spooled.run_id] = max(known, spooled.keyframe_id)
        return batch[-1].seq if batch else 0

    def _report_progress(self, progress: Publisher) -> None:
        """Publish the highest keyframe sent of each run."""
        for run_id, last in self._unreported.items():
            progress.put(Sent(run_id=run_id, last=last).encode())
        self._unreported.clear()
        self._progress_due_s = time.monotonic() + _PROGRESS_S

    def _queue(self, message: Received, kind: type[Ack] | type[Refusals]) -> None:
        """Queue an ack or refusals; called on Zenoh's thread."""
        if len(message.payload) > _MAX_ANSWER_BYTES:
            return
        try:
            answer = kind.decode(message.payload)
        except ValidationError:
            return  # not from a recorder of this version
        with self._changed:
            self._answers.append(answer)
            self._woken = True
            self._changed.notify_all()

    def _apply_answers(self) -> bool:
        """Apply the queued acks and refusals to the spool; True when envelopes left it."""
        freed = 0
        while self._answers:
            answer = self._answers.popleft()
            if isinstance(answer, Refusals):
                freed += self._spool.refuse(answer, up_to=self._sent)
            elif answer.key == self._key:  # else of the same bytes of another robot
                freed += self._spool.acknowledge(answer)
        if freed:
            with self._changed:
                self._changed.notify_all()
        return freed > 0

    def _wait(self, timeout_s: float) -> None:
        """Wait for `wake`, an answer, `stop` or the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self._woken or self._stopping, timeout_s)
            self._woken = False


class ResendTimer:
    """When to send again: a probe after silence, or everything once a recorder answers:
    ``recorder_answers`` is True when it has answered a probe, or acknowledged younger envelopes
    than the oldest, since `restart`."""

    def __init__(self, resend_after_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._resend_after_s = resend_after_s
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Start again: envelopes have just been sent."""
        self._pause_s = self._resend_after_s
        self._probed = self.recorder_answers = False
        self._due_s = self._clock() + self._pause_s

    def on_probe_sent(self) -> None:
        """Wait twice as long for the answer, at most ``_MAX_PAUSE_S``."""
        self._probed = True
        self._pause_s = min(2 * self._pause_s, _MAX_PAUSE_S)
        self._due_s = self._clock() + self._pause_s

    def on_oldest_answered(self) -> None:
        """An ack or refusal removed the oldest envelope."""
        self.recorder_answers = self._probed
        pause_s = self._resend_after_s
        if self._probed:
            pause_s = min(_AFTER_PROBE_S, self._resend_after_s)
        self._pause_s = self._resend_after_s
        self._due_s = self._clock() + pause_s

    def on_younger_answered(self) -> None:
        """An ack or refusal removed envelopes, but not the oldest."""
        self.recorder_answers = True
        self._due_s = min(self._due_s, self._clock() + self._resend_after_s)

    def expired(self) -> bool:
        """Whether it is time to send again."""
        return self._clock() >= self._due_s
