"""`mapfold relocalize --track`: questions one after the other, each answered with a line of JSON.

A line that is no question is answered with what is wrong, and the next one is read.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from eventsrc.text import counted
from projections.errors import QuestionError
from projections.relocalize import (
    Camera,
    Candidates,
    Crop,
    Track,
    movement_of,
    parse_json,
    rank,
    read_moved,
    read_question,
)

from .terminal import emit_lines

Search = Callable[[Sequence[Crop]], Candidates]
_MAX_LINE: Final = 16 * 1024 * 1024


@contextlib.contextmanager
def question_lines(query: str) -> Iterator[Iterator[bytes]]:
    """The lines of a file, or of stdin for ``-``, as they come; without empty ones.

    Raises QuestionError that names the file.
    """
    if query == "-":
        yield _lines(sys.stdin.buffer.readline, query)
        return
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(Path(query).open("rb"))
        except OSError as error:
            raise QuestionError(f"{query}: {error.strerror}; give a file of lines, or -") from None
        yield _lines(file.readline, query)


def _lines(read: Callable[[int], bytes], name: str) -> Iterator[bytes]:
    while line := read(_MAX_LINE + 1):
        if len(line) > _MAX_LINE:
            raise QuestionError(f"{name}: a line of more than {_MAX_LINE} bytes; send fewer crops")
        if line.strip():
            yield line


def print_tracked(
    lines: Iterator[bytes], search: Search, *, top: int, camera: Camera | None
) -> None:
    """Answer each line as soon as it comes. Raises QuestionError at the end if any was wrong."""
    track, asked, wrong = Track("relocalize --track"), 0, 0
    for line in lines:
        asked += 1
        try:
            document = _tracked(line, track, search, top, camera)
        except QuestionError as error:
            wrong += 1
            document = {"error": {"kind": "bad_question", "message": str(error)}}
        emit_lines([document])
        sys.stdout.flush()
    if wrong:
        raise QuestionError(
            f"{wrong} of {counted(asked, 'question')} could not be answered; stdout says why"
        )


def _tracked(
    line: bytes, track: Track, search: Search, top: int, camera: Camera | None
) -> dict[str, Any]:
    document = parse_json(line)
    question, moved = read_question(document), read_moved(document)
    answer = rank(question, search(question.crops), top=top, camera=camera)
    tracked = track.step(
        movement_of(moved, question), answer.hypotheses, answer.confidence, answer.known
    )
    return answer.document() | {"track": tracked.document()}
