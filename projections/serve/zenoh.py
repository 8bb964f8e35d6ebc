"""The service over Zenoh: ``mapfold/relocalize`` and ``mapfold/state/places|objects``.

Zenoh's thread only hands a question to the waiting room. What is too long is refused before it is
read, and when too many wait one is refused at once, so nobody waits for an answer that cannot come
in time. Every question gets a reply, an error if need be: silence would leave a lost robot waiting.
"""

import logging
from concurrent.futures import Future
from typing import Any, Final, Self

from eventsrc.errors import MapfoldError
from eventsrc.transport.session import Query, Session
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
            session.queryable(RELOCALIZE, self._take),
            session.queryable(f"{STATE}/**", self._take),
        ]
        session.confirm()

    def close(self) -> None:
        """Take no more questions. May be called twice."""
        for declared in self._declared:
            declared.close()
        self._declared = []

    def _take(self, query: Query) -> None:
        most = self._answerer.max_bytes
        if query.size > most or query.selector_size > MAX_SELECTOR:
            error = QuestionError(
                f"the question has {query.size} bytes behind a selector of {query.selector_size};"
                f" at most {most} and {MAX_SELECTOR} are taken"
            )
            query.reply_error(encode(refusal(error)[1]))
            return
        answered = self._room.submit(_PEER, lambda: self._document(query))
        answered.add_done_callback(lambda future: _reply(query, future))

    def _document(self, query: Query) -> tuple[str, dict[str, Any]]:
        if query.key == RELOCALIZE:
            return RELOCALIZE, self._answerer.relocalize(query.payload, query.parameters)
        what = query.key.removeprefix(f"{STATE}/")
        return query.key, self._answerer.state(what, query.parameters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _reply(query: Query, answered: "Future[tuple[str, dict[str, Any]]]") -> None:
    try:
        key, document = answered.result()
        query.reply(key, encode(document))
    except MapfoldError as error:
        query.reply_error(encode(refusal(error)[1]))
    finally:
        if not query.ended:  # a mistake of ours, which is logged; still no silence
            query.reply_error(encode(refusal(MapfoldError())[1]))
            _log.error("a question could not be answered", exc_info=answered.exception())
