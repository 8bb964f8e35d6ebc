"""Re-localise run B: questions of a few crops without a pose, and the errors of the answers.

The question is chosen regardless of the answer: the picture near the start with the most
detections, counting at most three; of several the first. It is asked with the most confident of
them, then with two, then three. Afterwards every keyframe of the run that shows anything is asked
once, to measure single questions.
"""

import json
import math
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from eventsrc.adapters.sim import SimulatedRun
from eventsrc.base.user_files import write_files
from eventsrc.envelope.model import RunId
from projections.adapters.drawing import LostRobot, Spot
from projections.localize.relocalize import Answer, rank, read_question
from projections.map.view import MapView
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader

from .folder import DemoFolder

MOST_CROPS: Final = 3
NEAR_M: Final = 1.5
"""Error up to which an estimate counts as right; the answer's ``confidence`` has the same bound."""


@dataclass(frozen=True, slots=True)
class AskedQuestion:
    """One question and its answer; ``error_m`` is None when no pose came back."""

    classes: tuple[str, ...]
    answer: Answer
    error_m: float | None
    seconds: float


@dataclass(frozen=True, slots=True)
class RunSummary:
    """One question from each of ``asked`` keyframes. Answers of "unknown" count as not near."""

    asked: int
    unknown: int
    near: int
    median_error_m: float
    seconds: float


@dataclass(frozen=True, slots=True)
class LostRun:
    """Run B's first questions, its true pose there, and a summary of its whole run."""

    run_id: RunId
    keyframe_id: int
    room: str
    truth: Spot
    questions: tuple[AskedQuestion, ...]
    everywhere: RunSummary

    @property
    def drawing(self) -> LostRobot:
        """For the picture: the last question's estimate."""
        pose = self.questions[-1].answer.pose if self.questions else None
        if pose is None:
            return LostRobot(self.truth, None)
        return LostRobot(self.truth, Spot(pose.x, pose.y, pose.yaw), pose.spread_m)


def ask_lost(targets: Targets, run: SimulatedRun, folder: DemoFolder) -> LostRun:
    """Ask the databases where run B is."""
    index = _first_question(run)
    pose, truth = run.true_poses[index], run.truth[index]
    best = _most_confident(run.envelopes[index]["detections"])
    with CandidateReader(targets) as reader:
        questions = tuple(
            _ask(reader, run, index, best[:count], folder) for count in range(1, len(best) + 1)
        )
        everywhere = _ask_whole_run(reader, run)
    return LostRun(
        run.run_id,
        truth["keyframe_id"],
        truth["room"],
        Spot(pose.x, pose.y, pose.yaw_rad),
        questions,
        everywhere,
    )


def place_rooms(view: MapView, run: SimulatedRun) -> dict[str, str]:
    """For each place the room most of its keyframes were truly taken in."""
    rooms = {line["keyframe_id"]: str(line["room"]) for line in run.truth}
    named: dict[str, str] = {}
    for place in view.places.values():
        seen = Counter(rooms[view.keyframes[member].keyframe_id] for member in place.members)
        named[place.place_id] = max(sorted(seen), key=lambda room: seen[room], default="?")
    return named


def _first_question(run: SimulatedRun) -> int:
    """The first keyframe near the start with the most detections, counting at most three.

    If those have none, the first keyframe of the run that has any.
    """
    start = run.true_poses[0]
    here = [
        index
        for index, pose in enumerate(run.true_poses)
        if math.dist((pose.x, pose.y), (start.x, start.y)) < 0.05
    ]
    shown = [min(len(envelope["detections"]), MOST_CROPS) for envelope in run.envelopes]
    best = max(here, key=lambda index: (shown[index], -index))
    return best if shown[best] else next(i for i, count in enumerate(shown) if count)


def _most_confident(detections: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(detections, key=lambda d: (-d["confidence"], d["det_id"]))[:MOST_CROPS]


def _ask(
    reader: CandidateReader,
    run: SimulatedRun,
    index: int,
    detections: Sequence[dict[str, Any]],
    folder: DemoFolder | None = None,
) -> AskedQuestion:
    question = {"crops": detections}
    if folder is not None:
        asked = json.dumps(question) + "\n"
        write_files({folder.question(len(detections)): asked.encode()})
    started = time.monotonic()
    crops = read_question(question).crops
    answer = rank(crops, reader.candidates(crops))
    seconds = time.monotonic() - started
    true, pose = run.true_poses[index], answer.pose
    error = None if pose is None else math.dist((pose.x, pose.y), (true.x, true.y))
    return AskedQuestion(tuple(d["class"] for d in detections), answer, error, seconds)


def _ask_whole_run(reader: CandidateReader, run: SimulatedRun) -> RunSummary:
    started = time.monotonic()
    asked = [
        _ask(reader, run, index, _most_confident(envelope["detections"]))
        for index, envelope in enumerate(run.envelopes)
        if envelope["detections"]
    ]
    known = [a.error_m for a in asked if a.error_m is not None and not a.answer.unknown]
    return RunSummary(
        asked=len(asked),
        unknown=len(asked) - len(known),
        near=sum(error <= NEAR_M for error in known),
        median_error_m=statistics.median(known) if known else math.nan,
        seconds=time.monotonic() - started,
    )
