"""The service over Zenoh: ``mapfold/relocalize`` and ``mapfold/state/places|objects``.

Zenoh's thread only hands a question to the waiting room. What is too long is refused before it is
read, and when too many wait one is refused at once, so nobody waits for an answer that cannot come
in time. Every question gets a reply, an error if need be: silence would leave a lost robot waiting.
"""

import logging
from concurrent.futures import Future
from typing import Any, Final, Self

from eventsrc.errors import MapfoldError
from eventsrc.transport.session import Asked, Session
from projections.errors import QuestionError

from .answering import Answerer, encode, refusal
from .room import Room

RELOCALIZE: Final = "mapfold/relocalize"
STATE: Final = "mapfold/state"
MAX_SELECTOR: Final = 4096
_PEER: Final = "zenoh"
"""Zenoh does not tell who asks: all of its questions share the turns of one peer."""
_log = logging.getLogger(__name__)


class ZenohService:
    """Answers on a session until closed; the room answers what it has taken by then."""

    def __init__(self, session: Session, answerer: Answerer, room: Room) -> None:
        self._answerer, self._room = answerer, room
        self._declared = [
            session.questions(RELOCALIZE, self._take),
            session.questions(f"{STATE}/**", self._take),
        ]
        session.confirm()

    def close(self) -> None:
        """Take no more questions. May be called twice."""
        for declared in self._declared:
            declared.close()
        self._declared = []

    def _take(self, asked: Asked) -> None:
        most = self._answerer.max_bytes
        if asked.size > most or asked.selector_size > MAX_SELECTOR:
            error = QuestionError(
                f"the question has {asked.size} bytes behind a selector of {asked.selector_size};"
                f" at most {most} and {MAX_SELECTOR} are taken"
            )
            asked.refuse(encode(refusal(error)[1]))
            return
        answered = self._room.submit(_PEER, lambda: self._document(asked))
        answered.add_done_callback(lambda future: _reply(asked, future))

    def _document(self, asked: Asked) -> tuple[str, dict[str, Any]]:
        if asked.key == RELOCALIZE:
            return RELOCALIZE, self._answerer.relocalize(asked.payload, asked.parameters)
        what = asked.key.removeprefix(f"{STATE}/")
        return asked.key, self._answerer.state(what, asked.parameters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _reply(asked: Asked, answered: "Future[tuple[str, dict[str, Any]]]") -> None:
    try:
        key, document = answered.result()
        asked.answer(key, encode(document))
    except MapfoldError as error:
        asked.refuse(encode(refusal(error)[1]))
    finally:
        if not asked.ended:  # a mistake of ours, which is logged; still no silence
            asked.refuse(encode(refusal(MapfoldError())[1]))
            _log.error("a question could not be answered", exc_info=answered.exception())
