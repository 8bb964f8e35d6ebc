"""What the service answers, whatever it is asked over: JSON in, JSON out, errors as replies.

A question is what ``mapfold relocalize`` takes; an object with crops may also say ``top`` and
``method``. Every refusal is ``{"error": {"kind", "message"}}`` with one of the kinds below.
"""

import json
import math
from collections.abc import Mapping
from typing import Any, Final, cast, get_args

from eventsrc.errors import MapfoldError
from projections.errors import DatabaseError, QuestionError
from projections.queries.near import objects_near, places_near
from projections.relocalize import DEFAULT_CAMERA, Camera, Method, rank, read_crops

from .limits import Bucket, TooMuchError
from .pools import Pools

MAX_TOP: Final = 100
DEFAULT_RADIUS_M: Final = 3.0
DEFAULT_MAX_BYTES: Final = 1_000_000
_KINDS: Final[tuple[tuple[type[MapfoldError], str, int], ...]] = (
    (TooMuchError, "too_much", 429),
    (QuestionError, "bad_question", 400),
    (DatabaseError, "database", 503),
)


class Answerer:
    """Answers questions from the live databases; safe to use from many threads."""

    def __init__(
        self,
        pools: Pools,
        *,
        per_second: float,
        max_bytes: int = DEFAULT_MAX_BYTES,
        camera: Camera = DEFAULT_CAMERA,
    ) -> None:
        self._pools, self._bucket, self._camera = pools, Bucket(per_second), camera
        self.max_bytes = max_bytes

    def relocalize(self, payload: bytes, options: Mapping[str, str]) -> dict[str, Any]:
        """The answer to a question, as ``relocalize --json`` gives it."""
        self._bucket.take()
        if len(payload) > self.max_bytes:
            raise QuestionError(
                f"the question has {len(payload)} bytes, more than {self.max_bytes}"
            )
        try:
            document = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise QuestionError(f"the question is not JSON: {error}") from None
        said = {**document, **options} if isinstance(document, dict) else dict(options)
        crops = read_crops(document)
        answer = rank(
            crops,
            self._pools.candidates(crops),
            top=_top(said.get("top", 3)),
            method=_method(said.get("method", "joint")),
            camera=self._camera,
        )
        return answer.document()

    def state(self, what: str, options: Mapping[str, str]) -> dict[str, Any]:
        """``places`` or ``objects`` near a pose: x, y and radius in metres."""
        self._bucket.take()
        x, y = _number(options, "x"), _number(options, "y")
        radius = _number(options, "radius", DEFAULT_RADIUS_M)
        if what == "places":
            return {"places": self._pools.on_graph(lambda c: places_near(c, x, y, radius))}
        if what == "objects":
            return {"objects": self._pools.on_graph(lambda c: objects_near(c, x, y, radius))}
        raise QuestionError(f"no state called {what!r}; there are places and objects")

    def health(self) -> dict[str, str]:
        """``{"status": "ok"}``. Raises DatabaseError when questions cannot be answered now."""
        self._pools.check()
        return {"status": "ok"}


def refusal(error: MapfoldError) -> tuple[int, dict[str, Any]]:
    """An HTTP status and the error as JSON."""
    for kind, name, status in _KINDS:
        if isinstance(error, kind):
            return status, {"error": {"kind": name, "message": str(error)}}
    return 500, {"error": {"kind": "failed", "message": str(error)}}


def encode(document: Mapping[str, Any]) -> bytes:
    """Compact UTF-8 JSON."""
    return json.dumps(document, ensure_ascii=False, allow_nan=False).encode()


def _top(value: Any) -> int:
    try:
        top = int(value)
    except (TypeError, ValueError):
        top = 0
    if not 1 <= top <= MAX_TOP:
        raise QuestionError(f"top is {value!r}; give a number from 1 to {MAX_TOP}")
    return top


def _method(value: Any) -> Method:
    if value in get_args(Method):
        return cast("Method", value)
    raise QuestionError(f"method is {value!r}; there are joint and plain")


def _number(options: Mapping[str, str], name: str, default: float | None = None) -> float:
    try:
        value = float(options[name]) if name in options or default is None else default
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise QuestionError(f"{name} is {options.get(name)!r}; give a number of metres")
    return value
