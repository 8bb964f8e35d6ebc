"""Answer questions over any transport: JSON in, JSON out, rate limited, errors as replies.

A question has the form of ``mapfold relocalize``; an object may also have ``top``, ``method`` and
``session``. Every refusal is ``{"error": {"kind", "message"}}`` with one of the kinds in
``_KINDS``.
"""

import contextlib
import json
import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple, TypeVar, cast, get_args

from eventsrc.base.errors import LogError, MapfoldError
from projections.ask.words import ObjectVectors
from projections.fold.map_errors import (
    DatabaseError,
    DatabaseUnavailable,
    FoldError,
    ProjectionMismatch,
    ProjectionMissing,
    QuestionError,
)
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import (
    Answer,
    Method,
    Question,
    describe_value,
    parse_json,
    rank,
    read_moved,
    read_question,
)
from projections.localize.relocalize.question import Movement
from projections.localize.relocalize.track import Track, movement_of
from projections.map.view import MapView
from projections.postgres.queries.live_view import LiveView
from projections.surfaces.text_encoders import words_of

from . import asked
from .pools import Pools
from .states import refuse_unknown, state_read

Result = TypeVar("Result")


class TooMuchError(MapfoldError):
    """More questions than the service answers; ask again later."""


class BusyError(TooMuchError):
    """Too many questions are queued, or this one has waited for too long."""


class TokenBucket:
    """A token bucket: ``per_second`` questions a second in the long run, twice as many at once."""

    def __init__(self, per_second: float, now: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._size = per_second, max(1.0, 2.0 * per_second)
        self._now, self._lock = now, threading.Lock()
        self._tokens, self._filled = self._size, now()

    def take_token(self) -> None:
        """Take a token. Raises TooMuchError when there is none."""
        with self._lock:
            now = self._now()
            self._tokens = min(self._size, self._tokens + (now - self._filled) * self._rate)
            self._filled = now
            if self._tokens < 1.0:
                raise TooMuchError(
                    f"more than {self._rate:g} questions a second; ask again in a second"
                )
            self._tokens -= 1.0


REPEAT_S: Final = 60.0
_MAX_LINES: Final = 100


class RepeatFilter:
    """Passes lines on to ``note``, each at once and again after ``REPEAT_S`` at the earliest.

    Repeats in between are counted. For any thread.
    """

    def __init__(
        self, note: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._note, self._now, self._lock = note, now, threading.Lock()
        self._passed: dict[str, tuple[float, int]] = {}  # when last passed on, and repeats since

    def __call__(self, line: str) -> None:
        """Pass ``line`` on, or count it."""
        with self._lock:
            now = self._now()
            at, count = self._passed.get(line, (-REPEAT_S, 0))
            if now - at < REPEAT_S:
                self._passed[line] = (at, count + 1)
                return
            if len(self._passed) >= _MAX_LINES:
                self._passed.clear()
            self._passed[line] = (now, 0)
        self._note(f"{line} (and {count} more like it since)" if count else line)


MOST_SESSIONS: Final = 256
SILENT_S: Final = 600.0
MAX_NAME: Final = 128


class Sessions:
    """Sessions of robots whose questions are tracked, by the names they give; for any thread.

    At most ``MOST_SESSIONS`` are kept. One without a question for ``SILENT_S`` is removed, and when
    there are more, the one that asked longest ago. If it asks again, a new session begins, and the
    answer has ``questions`` 1. Questions of a session are applied in the order of their
    answers. One that cannot be answered does not count: the robot's next movement is since the last
    answered one.
    """

    def __init__(
        self, now: Callable[[], float] = time.monotonic, most: int = MOST_SESSIONS
    ) -> None:
        self._now, self._most, self._lock = now, most, threading.Lock()
        self._kept: dict[str, tuple[float, Track]] = {}  # the longest silent first

    def __len__(self) -> int:
        with self._lock:
            self._forget()
            return len(self._kept)

    def tracked(self, name: str, moved: Movement, answer: Answer) -> dict[str, Any]:
        """The session's estimate of the robot's pose, as JSON."""
        with self._lock:  # a step takes a few milliseconds of numpy, so one lock is enough
            self._forget()
            _, track = self._kept.pop(name, (0.0, None))
            if track is None:
                track = Track(name)
            found = track.step(
                moved, answer.hypotheses, answer.confidence, answer.known, answer.looks
            )
            self._kept[name] = (self._now(), track)  # not before: a step that failed is discarded
            if len(self._kept) > self._most:
                del self._kept[next(iter(self._kept))]
            return found.document()

    def _forget(self) -> None:
        ended = self._now() - SILENT_S
        while self._kept:
            name, (at, _) = next(iter(self._kept.items()))
            if at > ended:
                return
            del self._kept[name]


def session_name(value: Any) -> str | None:
    """The name of a session, None for none. Raises QuestionError."""
    if value is None:
        return None
    if not isinstance(value, str) or not 1 <= len(value) <= MAX_NAME:
        raise QuestionError(
            f"session is {describe_value(value)}; give a name of 1 to {MAX_NAME} characters"
        )
    return value


HEALTH_S: Final = 1.0
"""For how long `Answerer.health` repeats the outcome of a check. A check opens connections: 4 ms of
this process and 11 ms of PostgreSQL's."""
MAX_TOP: Final = 100
OPTIONS: Final = ("top", "method", "session")
_DIGITS: Final = re.compile(r"[0-9]{1,9}", re.ASCII)
DEFAULT_MAX_BYTES: Final = 1_000_000
_KINDS: Final[tuple[tuple[type[MapfoldError], str, int, str | None], ...]] = (
    (BusyError, "too_much", 503, None),
    (TooMuchError, "too_much", 429, None),
    (asked.LogBusyError, "too_much", 429, None),
    (asked.NotInMapError, "bad_question", 404, None),
    (QuestionError, "bad_question", 400, None),
    (ProjectionMissing, "database", 503, "there is no map yet; ask again later"),
    (
        ProjectionMismatch,
        "database",
        503,
        "what is served is not of one map; see its stderr",
    ),
    (DatabaseUnavailable, "database", 503, "the database does not answer; ask again later"),
    (DatabaseError, "database", 503, "the database cannot be queried; see the service's stderr"),
    (MapfoldError, "failed", 500, "failed; see the service's stderr"),
)
"""Error, kind, HTTP status and the message in the reply (None: the error's own). Messages that name
databases and paths go only to the service's stderr (`Answerer`)."""


class Answerer:
    """Answers questions from the live databases; safe to use from many threads.

    ``note`` gets a line for people when a question fails because of the database. Without a ``log``
    beside them, `changes`, `crop` and past maps are refused.
    """

    def __init__(
        self,
        pools: Pools,
        *,
        per_second: float,
        max_bytes: int = DEFAULT_MAX_BYTES,
        camera: CameraConstants | None = None,
        log: asked.ServedLog | None = None,
        note: Callable[[str], None] = lambda _: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pools, self._bucket, self._camera = pools, TokenBucket(per_second, now), camera
        self._log, self._note = log, RepeatFilter(note)
        self._now, self._checking = now, threading.Lock()
        self._checked_s = -math.inf
        self._unhealthy: DatabaseError | None = None
        # One at a time: the JSON parser holds the GIL for up to 30 ms, and the thread that reads
        # from the network must run in between.
        self._parsing = threading.Lock()
        self._sessions = Sessions()
        self.max_bytes = max_bytes
        self.database_up = True
        """False after a question or health probe that failed because of the database, until one
        succeeds."""

    def relocalize(self, payload: bytes, options: Mapping[str, str]) -> dict[str, Any]:
        """The answer to a question, as ``relocalize --json`` gives it."""
        if len(payload) > self.max_bytes:
            raise QuestionError(
                f"the question has {len(payload)} bytes, more than {self.max_bytes}"
            )
        refuse_unknown(options, OPTIONS)
        with self._parsing:
            read = _read(payload, options)
        question = read.question
        with self._reporting_errors():
            self._bucket.take_token()
            candidates = self._pools.candidates(question.crops)
        answer = rank(question, candidates, top=read.top, method=read.method, camera=self._camera)
        if read.session is None:
            return answer.document()
        followed = answer  # only the method joint has poses that can be followed
        if read.method != "joint":
            followed = rank(question, candidates, camera=self._camera)
        moved = movement_of(read.moved, question)
        tracked = self._sessions.tracked(read.session, moved, followed)
        return answer.document() | {"track": tracked}

    def state(self, what: str, options: Mapping[str, str]) -> dict[str, Any]:
        """``places`` or ``objects``: near a position (x, y and radius in metres), or a page of all
        of them (limit, cursor)."""
        read = state_read(what, options)
        with self._reporting_errors():
            self._bucket.take_token()
            return self._pools.on_graph(read)

    def ask(self, question: asked.MapQuestion) -> dict[str, Any]:
        """The answer to a question of the map. Raises NotInMapError."""
        return asked.asked(question, self._view())

    def find(self, query: asked.FindQuery) -> dict[str, Any]:
        """The Objects that are asked for, in a past map by the log. Raises NotInMapError."""
        if query.at is None and query.known_at is None:
            return self.ask(query.question(lambda view: words_of(view, self._vectors)))
        return self._ask_log(asked.NO_LOG_OF_THE_PAST, lambda log, view: log.find(view, query))

    def _vectors(self, _: MapView) -> ObjectVectors:
        with self._reporting_errors():
            return self._pools.object_vectors()

    def changes(self, query: asked.ChangesQuery) -> dict[str, Any]:
        """A page of what changed in the building. Raises NotInMapError."""
        return self._ask_log(asked.NO_LOG, lambda log, view: log.changes(view, query))

    def crop(self, name: str) -> bytes:
        """The JPEG of a detection, or of an Object's best view. Raises NotInMapError."""
        return self._ask_log(asked.NO_LOG_OF_CROPS, lambda log, view: log.crop(view, name))

    def _ask_log(self, missing: str, ask: Callable[[asked.ServedLog, LiveView], Result]) -> Result:
        """The log's answer; without one NotInMapError with the text ``missing``."""
        if self._log is None:
            raise asked.NotInMapError(missing)
        view = self._view()
        with self._reporting_errors():
            try:
                return ask(self._log, view)
            except (FoldError, LogError) as error:
                self._note(f"mapfold: {error}")
                raise

    def _view(self) -> LiveView:
        with self._reporting_errors():
            self._bucket.take_token()
            return self._pools.view()

    @property
    def session_count(self) -> int:
        """How many sessions are tracked."""
        return len(self._sessions)

    def health(self) -> dict[str, str]:
        """``{"status": "ok"}``. Raises DatabaseError when questions cannot be answered.

        The databases are checked at most every ``HEALTH_S``, and again after a question that failed
        because of them; in between the last outcome is repeated.
        """
        with self._checking:
            if self._now() - self._checked_s >= HEALTH_S:
                self._check()
            if self._unhealthy is not None:
                raise self._unhealthy.with_traceback(None)  # it would grow with every probe
        return {"status": "ok"}

    def _check(self) -> None:
        self._unhealthy = None
        try:
            with self._reporting_errors():
                self._pools.check()
        except DatabaseError as error:
            self._unhealthy = error
        self._checked_s = self._now()

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        try:
            yield
        except DatabaseError as error:
            self.database_up = False
            self._checked_s = -math.inf
            self._note(f"mapfold: {error}")
            raise
        except MapfoldError:
            raise  # not an error of the database
        self.database_up = True


def refusal(error: MapfoldError) -> tuple[int, dict[str, Any]]:
    """The HTTP status and the JSON form of an error."""
    for kind, name, status, text in _KINDS:
        if isinstance(error, kind):
            return status, {"error": {"kind": name, "message": text or str(error)}}
    raise AssertionError(error)  # the last kind is the base class


def encode(document: Mapping[str, Any]) -> bytes:
    """Compact UTF-8 JSON."""
    return json.dumps(document, ensure_ascii=False, allow_nan=False).encode()


class _Asked(NamedTuple):
    question: Question
    top: int
    method: Method
    session: str | None
    moved: Movement


def _read(payload: bytes, options: Mapping[str, str]) -> _Asked:
    document = parse_json(payload)
    fields = document if isinstance(document, dict) else {}
    # A value in the question is checked even if an option overrides it.
    top = _top(fields.get("top", 3))
    method = _method(fields.get("method", "joint"))
    session = session_name(fields.get("session"))
    if "top" in options:
        top = _top(int(options["top"]) if _DIGITS.fullmatch(options["top"]) else options["top"])
    method = _method(options.get("method", method))
    session = session_name(options.get("session", session))
    return _Asked(read_question(document), top, method, session, read_moved(document))


def _top(value: Any) -> int:
    if isinstance(value, float) and value.is_integer():  # 3.0 is an integer in JSON schemas
        value = int(value)
    if type(value) is not int or not 1 <= value <= MAX_TOP:
        raise QuestionError(f"top is {describe_value(value)}; give a number from 1 to {MAX_TOP}")
    return value


def _method(value: Any) -> Method:
    if isinstance(value, str) and value in get_args(Method):
        return cast("Method", value)
    raise QuestionError(f"method is {describe_value(value)}; there are joint and plain")
