"""The service over Zenoh: ``mapfold/relocalize`` and ``mapfold/state/places|objects``.

Zenoh's thread only hands a question to the workers. When as many wait as may, it is refused at
once, so nobody waits for an answer that cannot come in time. Every question gets a reply, an error
if need be: silence would leave a lost robot waiting.
"""

import logging
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final, Self

from eventsrc._zenoh import Asked, Session
from eventsrc.errors import MapfoldError

from .answering import Answerer, encode, refusal
from .limits import TooMuchError

RELOCALIZE: Final = "mapfold/relocalize"
STATE: Final = "mapfold/state"
WAITING: Final = 64
_log = logging.getLogger(__name__)


class ZenohService:
    """Answers on a session until closed; questions taken by then are answered first."""

    def __init__(self, session: Session, answerer: Answerer, workers: int) -> None:
        self._answerer = answerer
        self._room = threading.BoundedSemaphore(WAITING)
        self._workers = ThreadPoolExecutor(workers, thread_name_prefix="answer")
        self._declared = [
            session.questions(RELOCALIZE, self._take),
            session.questions(f"{STATE}/**", self._take),
        ]
        session.confirm()

    def close(self) -> None:
        """Take no more questions and answer those taken. May be called twice."""
        for declared in self._declared:
            declared.close()
        self._declared = []
        self._workers.shutdown(wait=True)

    def _take(self, asked: Asked) -> None:
        if not self._room.acquire(blocking=False):
            error = TooMuchError(f"{WAITING} questions are waiting already; ask again later")
            asked.refuse(encode(refusal(error)[1]))
            return
        try:
            self._workers.submit(self._answer, asked).add_done_callback(self._done)
        except RuntimeError:  # the service is closing
            self._room.release()
            asked.refuse(encode(refusal(MapfoldError("the service is ending"))[1]))

    def _answer(self, asked: Asked) -> None:
        try:
            key, document = self._document(asked)
            asked.answer(key, encode(document))
        except MapfoldError as error:
            asked.refuse(encode(refusal(error)[1]))
        finally:
            if not asked.ended:  # a mistake of ours, which `_done` reports; still no silence
                asked.refuse(encode(refusal(MapfoldError("failed; see the service's log"))[1]))

    def _done(self, answered: "Future[None]") -> None:
        self._room.release()
        error = answered.exception()
        if error is not None:
            _log.error("a question could not be answered", exc_info=error)

    def _document(self, asked: Asked) -> tuple[str, dict[str, Any]]:
        if asked.key == RELOCALIZE:
            return RELOCALIZE, self._answerer.relocalize(asked.payload, asked.parameters)
        what = asked.key.removeprefix(f"{STATE}/")
        return asked.key, self._answerer.state(what, asked.parameters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
