"""The robot's sending thread: from the spool to a recorder, until the recorder has it on disk.

* Nothing is sent while nobody subscribes; the spool only grows. When somebody appears, sending
  begins anew at the oldest envelope that is not acknowledged.
* At most ``window`` envelopes are under way, so that a long spool does not flood the recorder's
  queue. An ack makes room for more.
* When acks stay away longer than the resend time, the oldest envelope is sent again, alone, as a
  question whether anybody is still there; each question in vain doubles the pause. Once there is an
  answer and it does not cover the rest, sending goes back to the oldest.
* Acks come in the order of sending. When the oldest envelope waits for the resend time while
  younger ones are acknowledged, it was lost on the way, and sending goes back to it; else what was
  lost would fill the window for good. It also goes back when the last subscriber has left and
  another is there, however soon.
* Beside the envelopes it tells how far it has got with each run (`eventsrc.robot.acks`): at most
  twice a second, and when it ends. So a recorder misses the last ones of a run, too.
* What a recorder says it has refused is set aside: it would be refused for ever, and hold up all
  that comes after it.
* Answers come in on Zenoh's thread, which only hands them over. They are taken whether or not
  anybody subscribes: a recorder's last acks arrive when it has just unsubscribed.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from pydantic import ValidationError

from eventsrc.errors import MisuseError, SpoolError, TransportError
from eventsrc.transport.session import Publisher, Received, Session, ZenohOptions, open_session

from .acks import Ack, Refusals, Sent, ack_key, refusal_key, sent_key
from .spool import Spool, Spooled

WINDOW: Final = 1_024
"""With a group commit every 50 ms this allows about 20,000 envelopes a second."""
RESEND_AFTER_S: Final = 2.0
_LONGEST_PAUSE_S: Final = 30.0
_REST_S: Final = 0.5
"""After the answer to a question: how long the acks of the rest may take. They come in groups."""
_RECONNECT_S: Final = 1.0
_TELL_EVERY_S: Final = 0.5
_MAX_ANSWER_BYTES: Final = 4 * 1024 * 1024
"""What is larger was not sent by a recorder."""
_LOOK_S: Final = 0.25
"""How often to look whether a recorder is still there, and how long stopping may take."""


class Sender:
    """`run` is the life of the sending thread; the other methods are for all other threads."""

    def __init__(
        self,
        options: ZenohOptions,
        key: str,
        spool: Spool,
        *,
        window: int = WINDOW,
        resend_after_s: float = RESEND_AFTER_S,
    ) -> None:
        self._options = options
        self._key = key
        self._spool = spool
        self._window = window
        self._resend_after_s = resend_after_s
        self._changed = threading.Condition()
        self._answers: deque[Ack | Refusals] = deque()
        self._sent = 0  # the last seq that was ever sent
        self._untold: dict[str, int] = {}  # by run: the highest keyframe sent since it was told of
        self._tell_due_s = 0.0
        self._news = self._stopping = False
        self._failure: TransportError | None = None

    def wake(self) -> None:
        """Something was spooled."""
        with self._changed:
            self._news = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Make `run` return soon."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def raise_failure(self) -> None:
        """Raise what ended the thread early, if anything did."""
        if self._failure is not None:
            raise self._failure

    def wait_until_answered(self, timeout_s: float) -> bool:
        """Wait until nothing waits in the spool; False when it was not so in time."""
        with self._changed:
            self._changed.wait_for(lambda: not len(self._spool) or self._failure, timeout_s)
        self.raise_failure()
        return not len(self._spool)

    def run(self) -> None:
        """Connect, send, and connect again, until stopped or the spool fails."""
        try:
            while not self._stopping:
                self._connect_and_serve()
        finally:
            if not self._stopping:  # so that nobody spools for a thread that is gone
                self._failure = TransportError(
                    f"key {self._key!r}: the sending thread has died, stderr says of what; what is "
                    "spooled stays. Close this publisher and open another"
                )
                self.stop()

    def _connect_and_serve(self) -> None:
        try:
            with open_session(self._options, mode=self._options.mode) as session:
                self._serve(session)
        except SpoolError as failure:
            self._failure = failure
            self.stop()
        except (TransportError, MisuseError):  # nobody there, or the configuration file is not
            self._rest(_RECONNECT_S)  # any more; the spool keeps everything meanwhile

    def _serve(self, session: Session) -> None:
        publisher, teller = session.publisher(self._key), session.publisher(sent_key(self._key))
        session.subscribe(refusal_key(self._key), lambda said: self._hear(said, Refusals))
        heard: set[str] = set()
        try:
            while not self._stopping:
                self._take_answers()
                if publisher.wait_for_subscriber(_LOOK_S):
                    self._converse(session, publisher, teller, heard)
        finally:
            with contextlib.suppress(TransportError):  # nobody is there to be told any more
                self._tell(teller)
            self._take_answers()

    def _converse(
        self, session: Session, publisher: Publisher, teller: Publisher, heard: set[str]
    ) -> None:
        """Send and hear acks while somebody subscribes; ``heard`` are the runs listened for."""
        cursor, oldest = 0, self._spool.oldest()
        departures = publisher.departures
        patience = Patience(self._resend_after_s)
        while not self._stopping and publisher.has_subscriber:
            if publisher.departures != departures:
                return
            if self._take_answers():
                before, oldest = oldest, self._spool.oldest()
                patience.answered() if oldest != before else patience.passed_over()
            if self._untold and time.monotonic() >= self._tell_due_s:
                self._tell(teller)
            under_way = self._spool.waiting_up_to(cursor)
            batch = self._spool.after(cursor, self._window - under_way)
            if batch:
                self._listen(session, batch, heard)
                cursor = self._send(publisher, batch)
                if not under_way:
                    patience.begin()
            elif under_way and patience.is_over():
                if patience.somebody_answered:
                    cursor = 0
                    patience.begin()
                else:
                    self._send(publisher, self._spool.after(0, 1))
                    patience.ask()
            else:
                self._wait(_LOOK_S)

    def _listen(self, session: Session, batch: list[Spooled], heard: set[str]) -> None:
        """Subscribe to the acks of every run in ``batch`` before any of it is sent."""
        new = {spooled.run_id for spooled in batch} - heard
        for run_id in sorted(new):
            session.subscribe(ack_key(run_id), lambda said: self._hear(said, Ack))
        if new:
            session.confirm()
            heard |= new

    def _send(self, publisher: Publisher, batch: list[Spooled]) -> int:
        """Send ``batch`` and return where it ends."""
        for spooled in batch:
            publisher.put(spooled.payload)
            self._sent = max(self._sent, spooled.seq)
            known = self._untold.get(spooled.run_id, spooled.keyframe_id)
            self._untold[spooled.run_id] = max(known, spooled.keyframe_id)
        return batch[-1].seq if batch else 0

    def _tell(self, teller: Publisher) -> None:
        """Say how far each run was sent."""
        for run_id, last in self._untold.items():
            teller.put(Sent(run_id=run_id, last=last).encode())
        self._untold.clear()
        self._tell_due_s = time.monotonic() + _TELL_EVERY_S

    def _hear(self, message: Received, kind: type[Ack] | type[Refusals]) -> None:
        if len(message.payload) > _MAX_ANSWER_BYTES:
            return
        try:
            answer = kind.decode(message.payload)
        except ValidationError:
            return  # not from a recorder we understand, so nothing is answered
        with self._changed:
            self._answers.append(answer)
            self._news = True
            self._changed.notify_all()

    def _take_answers(self) -> bool:
        """Let go of what was answered; True when that was anything."""
        freed = 0
        while self._answers:
            freed += self._take(self._answers.popleft())
        if freed:
            with self._changed:
                self._changed.notify_all()
        return freed > 0

    def _take(self, answer: Ack | Refusals) -> int:
        if isinstance(answer, Ack):
            # Of the same bytes under another key, the log has the other robot's.
            return self._spool.acknowledge(answer) if answer.key == self._key else 0
        return self._spool.refuse(answer, up_to=self._sent)

    def _wait(self, timeout_s: float) -> None:
        """Until there is news, or the time is up."""
        with self._changed:
            self._changed.wait_for(lambda: self._news or self._stopping, timeout_s)
            self._news = False

    def _rest(self, timeout_s: float) -> None:
        """Until the time is up, whatever is spooled meanwhile."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping, timeout_s)


class Patience:
    """How long to wait for acks before something is sent again."""

    def __init__(self, resend_after_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._resend_after_s = resend_after_s
        self._clock = clock
        self.begin()

    def begin(self) -> None:
        """Something new is under way."""
        self._pause_s = self._resend_after_s
        self._asked = self.somebody_answered = False
        self._over_s = self._clock() + self._pause_s

    def ask(self) -> None:
        """A question was sent."""
        self._asked = True
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._over_s = self._clock() + self._pause_s

    def answered(self) -> None:
        """An ack freed the oldest."""
        self.somebody_answered = self._asked
        wait_s = min(_REST_S, self._resend_after_s) if self._asked else self._resend_after_s
        self._pause_s = self._resend_after_s
        self._over_s = self._clock() + wait_s

    def passed_over(self) -> None:
        """An ack freed others than the oldest."""
        self.somebody_answered = True
        self._over_s = min(self._over_s, self._clock() + self._resend_after_s)

    def is_over(self) -> bool:
        """Whether acks have stayed away too long."""
        return self._clock() >= self._over_s
