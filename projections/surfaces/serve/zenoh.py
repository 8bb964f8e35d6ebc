"""The service over Zenoh: ``mapfold/relocalize``, ``mapfold/find`` and
``mapfold/state/places|objects``.

Zenoh's thread only puts a question into the `FairQueue`. One that is too long is refused before it
is read, and when too many wait one is refused at once. Every question gets a reply, if need be an
error: without one a robot would wait for its timeout.
"""

import logging
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final, Self

from eventsrc.base.errors import MapfoldError
from eventsrc.record.transport.session import Query, Session
from projections.fold.map_errors import QuestionError

from .answering import Answerer, encode, refusal
from .asked import FindQuery
from .fair_queue import FairQueue

RELOCALIZE: Final = "mapfold/relocalize"
FIND: Final = "mapfold/find"
STATE: Final = "mapfold/state"
MAX_SELECTOR: Final = 4096
_PEER: Final = "zenoh"
"""Zenoh does not identify the client: all its questions count as one peer's."""
_log = logging.getLogger(__name__)


class ZenohService:
    """Answers queries on a Zenoh session until closed; questions queued by then are still answered.

    ``watch`` gets ``zenoh``, what is asked and the future answer of each question, to count it.
    """

    def __init__(
        self,
        session: Session,
        answerer: Answerer,
        queue: FairQueue,
        watch: Callable[[str, str, "Future[Any]"], None] = lambda *_: None,
    ) -> None:
        self._answerer, self._queue, self._watch = answerer, queue, watch
        self._declared = [
            session.queryable(RELOCALIZE, self._receive),
            session.queryable(FIND, self._receive),
            session.queryable(f"{STATE}/**", self._receive),
        ]
        session.confirm()

    def close(self) -> None:
        """Stop receiving questions. May be called twice."""
        for declared in self._declared:
            declared.close()
        self._declared = []

    def _receive(self, query: Query) -> None:
        most = self._answerer.max_bytes
        if query.size > most or query.selector_size > MAX_SELECTOR:
            error = QuestionError(
                f"the question has {query.size} bytes behind a selector of {query.selector_size};"
                f" at most {most} and {MAX_SELECTOR} are taken"
            )
            query.reply_error(encode(refusal(error)[1]))
            return
        answered = self._queue.submit(_PEER, lambda: self._document(query))
        self._watch(_PEER, query.key.rpartition("/")[2], answered)
        answered.add_done_callback(lambda future: _reply(query, future))

    def _document(self, query: Query) -> tuple[str, dict[str, Any]]:
        # Names with an underscore in front are Zenoh's own.
        options = {n: value for n, value in query.parameters.items() if not n.startswith("_")}
        if query.key == RELOCALIZE:
            return RELOCALIZE, self._answerer.relocalize(query.payload, options)
        if query.key == FIND:
            return FIND, self._answerer.find(FindQuery.read(options))
        return query.key, self._answerer.state(query.key.removeprefix(f"{STATE}/"), options)

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
        if not query.ended:  # an unexpected exception, which is logged
            query.reply_error(encode(refusal(MapfoldError())[1]))
            _log.error("a question could not be answered", exc_info=answered.exception())
