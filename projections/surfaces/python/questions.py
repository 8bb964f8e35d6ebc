"""`relocalize`: where in a map are these crops seen from?"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, read_file
from projections.fold.settings import Camera
from projections.localize.relocalize import (
    Answer,
    ExactIndex,
    Method,
    Question,
    parse_question,
    rank,
    read_question,
)
from projections.localize.relocalize.reading import MAX_QUESTION_BYTES

from .map import Map

QuestionLike: TypeAlias = Question | Mapping[str, Any] | Sequence[Mapping[str, Any]] | str | Path

_INDEXES: "WeakKeyDictionary[Map, ExactIndex]" = WeakKeyDictionary()


def relocalize(
    house: Map,
    question: QuestionLike,
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera | None = None,
) -> Answer:
    """The likeliest Places and the pose of a robot that sees some crops.

    ``question`` is an envelope, a list of crops, a document of views (docs/relocalization.md), or
    the path of a file of these. ``top`` Places are listed. The search is exact; the map's vectors
    are laid out at its first question. Raises QuestionError for a question that cannot be read, of
    another embedding space, or of a class that the map does not have, MisuseError for a map folded
    without embeddings.

    Examples:
        >>> house = fold("logs/sample", settings={"eps_m": 0.75, "min_samples": 8})
        >>> answer = relocalize(house, [{"class": "toilet"}, {"class": "mirror"}])
        >>> [place.place_id for place in answer.places]
        ['sim-7-a_p0', 'sim-7-a_p12', 'sim-7-a_p11']
    """
    if not house.view.keep_embeddings:
        raise MisuseError("this map was folded with embeddings=False; fold it with them to ask it")
    index = _INDEXES.get(house)
    if index is None:
        index = _INDEXES[house] = ExactIndex(house.view)
    asked = _read(question)
    return rank(asked, index.search(asked.crops), top=top, method=method, camera=camera)


def _read(question: QuestionLike) -> Question:
    if isinstance(question, Question):
        return question
    if not isinstance(question, str | Path):
        return read_question(question)
    try:
        return parse_question(read_file(Path(question), MAX_QUESTION_BYTES))
    except FileFault as fault:
        raise MisuseError(f"question {question}: {fault}; give a file of JSON") from None
