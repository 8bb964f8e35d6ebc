"""`mapfold relocalize`: find a robot's Place and pose from a few object crops or classes.

With ``--track`` it answers a stream of questions, each with a line of JSON. An invalid line is
answered with an error.
"""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, shorten_by
from eventsrc.base.user_files import FileFault, open_file
from eventsrc.log import LogReader
from projections.fold.map_errors import QuestionError
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import (
    UNKNOWN_BELOW,
    Answer,
    ExactIndex,
    MapCandidates,
    Method,
    Question,
    QuestionCrop,
    RankedPlace,
    parse_json,
    rank,
    read_moved,
    read_question,
)
from projections.localize.relocalize.track import Track, movement_of
from projections.map.naming import ShortIds, things_of
from projections.map.parsing import read_corrections
from projections.map.state_output import camera_advice
from projections.store.history_recorder import map_after

from .folded_log import FoldSettings, W, point, say_defaults
from .options import (
    CameraOptions,
    Databases,
    JsonOption,
    OptionalQuestion,
    method_from,
    option,
    question_from,
)
from .terminal import display, emit, emit_lines, say


def relocalize(
    *,
    query: OptionalQuestion = None,
    track: Annotated[
        bool,
        typer.Option(
            "--track",
            help="Follow a robot: QUERY (else stdin) has one question a line, with dx, dy and dyaw"
            " since the one before; each is answered with a line of JSON.",
        ),
    ] = False,
    classes: Annotated[
        list[str] | None,
        option(
            "CLASS",
            "Ask where a thing of this class is near, instead of QUERY; may be repeated.",
            "--class",
        ),
    ] = None,
    top: Annotated[int, option("N", "Places to list.", "--top", min=1, max=100)] = 3,
    as_of: Annotated[
        str | None, option("W", f"Ask the map as it was: {W} of --log.", "--as-of")
    ] = None,
    log: Annotated[
        Path | None, option("LOG", "Ask this log, folded, instead of the live map.", "--log")
    ] = None,
    method: Annotated[
        str,
        option(
            "joint|plain",
            "joint: by poses, from all crops together; plain: similarities summed per Place.",
            "--method",
        ),
    ] = "joint",
    camera_options: CameraOptions,
    databases: Databases,
    chosen: FoldSettings,
    json_: JsonOption = False,
) -> None:
    """Find where a robot is, from a few object crops or classes.

    Ranked Places with evidence, a pose hypothesis, how likely it is right (confidence) and how
    likely the map has the things shown (known).
    """
    how, camera = method_from(method), camera_options.camera
    if as_of is not None and log is None:
        raise MisuseError("--as-of asks a past map, which only the log knows; give --log LOG too")
    with contextlib.ExitStack() as stack:
        if track:
            _refuse_to_track(classes, how)
            lines = stack.enter_context(question_lines(query or "-"))
        else:
            question = _question(query, classes)
        if log is None:
            chosen.of_past_map(log)
            # Here: `evaluate` and `whatif` import this module and ask no database.
            from projections.postgres.queries.candidate_search import CandidateReader

            targets = stack.enter_context(databases.opened())
            reader = stack.enter_context(CandidateReader(targets))
            search: Search = reader.candidates
            if not json_ and not track:
                shorten_by(reader.short_ids().text)
        else:
            with LogReader(log) as recorded:
                end = point(recorded, as_of or "end")
                corrections = read_corrections(recorded, end)
                settings = chosen.of_past_map(log, corrections)
                view = map_after(
                    recorded, settings, end, corrections=corrections, note=say, embeddings=True
                )
            shorten_by(ShortIds.of(things_of(view)).text)
            search = ExactIndex(view).search
            say_defaults(settings)
            unstated = view.without_camera() if settings.wants_camera else 0
            if unstated and (camera or (None if track else question.camera)) is not None:
                where = f"for {counted(unstated, 'keyframe')} of the map, as it is for the question"
                say(camera_advice(where, settings, log))
        if track:
            print_tracked(lines, search, top=top, camera=camera)
        else:
            answer = rank(question, search(question.crops), top=top, method=how, camera=camera)
            _print_answer(answer, json_)


def _refuse_to_track(classes: list[str] | None, method: Method) -> None:
    """Raise MisuseError for options that do not go with ``--track``."""
    if classes:
        raise MisuseError("--track reads questions from QUERY or stdin; ask without --class")
    if method != "joint":
        raise MisuseError("--track follows the poses of --method joint; ask without --method plain")


def _question(query: str | None, classes: list[str] | None) -> Question:
    """The question: QUERY, or one picture with things of the classes. Raises MisuseError."""
    if (query is None) == (not classes):
        raise MisuseError("give either QUERY, the crops that the robot sees, or --class CLASS")
    if query is not None:
        return question_from(query)
    return read_question([{"class": name} for name in classes or ()])


def _print_answer(answer: Answer, as_json: bool) -> None:
    if answer.thin is not None:
        say(f"the map is thin, {answer.thin}: do not trust the answer until it has seen more")
    if answer.unlooked:
        crops = counted(answer.unlooked, "crop")
        say(f"the map has no embeddings, so those of {crops} say nothing: asked by class and box")
    if not as_json:
        display(answer_text(answer))
        return
    emit(answer.document())
    if answer.unknown:
        say(f"unknown: {_known_text(answer)} is below {UNKNOWN_BELOW}")


def answer_text(answer: Answer) -> str:
    """The answer for people: place and confidence, pose, ranked places with their evidence."""
    lines = [_first_line(answer), _pose_line(answer)]
    for number, place in enumerate(answer.places, start=1):
        lines += _place_lines(number, place)
    return "\n".join(line for line in lines if line) + "\n"


def _first_line(answer: Answer) -> str:
    if not answer.places:
        return f"unknown: nothing in the map looks like these crops ({_known_text(answer)})"
    if answer.unknown:
        below = f"{_known_text(answer)} is below {UNKNOWN_BELOW}"
        return f"unknown: {below}; the likeliest places would be"
    confidence = f"confidence {answer.confidence:.2f}"
    return f"{_place_text(answer.places[0])} ({confidence}, {_known_text(answer)})"


_UNSURE: Final = 0.05


def _known_text(answer: Answer) -> str:
    """The probability that the things shown are in the map, and how unsure it is if it is."""
    spread = answer.known_spread or 0.0
    return f"known {answer.known:.2f}" + (f" ± {spread:.2f}" if spread >= _UNSURE else "")


def _place_text(place: RankedPlace) -> str:
    """A Place's id, and beside it its name and its floor if it has them."""
    name = "" if place.name is None else f" “{place.name}”"
    floor = "" if place.floor is None else f" on floor {place.floor}"
    return f"{place.place_id}{name}{floor}"


def _pose_line(answer: Answer) -> str:
    pose = answer.pose
    if pose is None:
        return ""
    yaw = "" if pose.yaw is None else f", facing {math.degrees(pose.yaw):.0f}°"
    floor = "" if pose.floor is None else f" on floor {pose.floor}"
    return f"pose ({pose.x:.2f}, {pose.y:.2f}) m{floor}{yaw}, spread {pose.spread_m:.2f} m"


def _place_lines(number: int, place: RankedPlace) -> list[str]:
    centroid = f"({place.centroid_x:.2f}, {place.centroid_y:.2f}) m"
    lines = [f"{number}. {_place_text(place)}  score {place.score:.3f}  centroid {centroid}"]
    for seen in place.evidence:
        likeness = f"{seen.similarity:.3f}" if seen.compared else "class"
        object_id = seen.object_id or "no object"
        lines.append(f"   {likeness}  {seen.class_name}  {object_id}  {seen.det_id}")
    return lines


Search = Callable[[Sequence[QuestionCrop]], MapCandidates]
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
            file = stack.enter_context(open_file(Path(query)))
        except FileFault as fault:
            raise QuestionError(f"{query}: {fault}; give a file of lines, or -") from None
        yield _lines(file.readline, query)


def _lines(read: Callable[[int], bytes], name: str) -> Iterator[bytes]:
    while line := read(_MAX_LINE + 1):
        if len(line) > _MAX_LINE:
            raise QuestionError(f"{name}: a line of more than {_MAX_LINE} bytes; send fewer crops")
        if line.strip():
            yield line


def print_tracked(
    lines: Iterator[bytes], search: Search, *, top: int, camera: CameraConstants | None
) -> None:
    """Answer each line as soon as it comes. Raises QuestionError at the end if any was invalid."""
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
    line: bytes, track: Track, search: Search, top: int, camera: CameraConstants | None
) -> dict[str, Any]:
    document = parse_json(line)
    question, moved = read_question(document), read_moved(document)
    answer = rank(question, search(question.crops), top=top, camera=camera)
    tracked = track.step(
        movement_of(moved, question),
        answer.hypotheses,
        answer.confidence,
        answer.known,
        answer.looks,
    )
    return answer.document() | {"track": tracked.document()}
