"""Sessions of the service: bounded in number and age, each with its own track."""

import threading

import numpy as np
import pytest

from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import Answer, PoseHypothesis
from projections.localize.relocalize.layout import Hypotheses
from projections.localize.relocalize.track import Track
from projections.surfaces.serve.answering import MAX_NAME, SILENT_S, Sessions, session_name

STILL = (0.0, 0.0, 0.0)


class Clock:
    """Goes by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def answer(x: float = 1.0) -> Answer:
    found = Hypotheses(np.array([[x, 2.0, 0.5]]), np.array([1.0]), (None,))
    return Answer((), PoseHypothesis(x, 2.0, 0.5, 0.1), 0.9, hypotheses=found)


def questions(sessions: Sessions, name: str) -> int:
    return int(sessions.tracked(name, STILL, answer())["questions"])


def test_a_session_is_the_track_of_its_name() -> None:
    sessions, track = Sessions(), Track("robot-7")
    for x in (1.0, 1.5, 2.0):
        moved = (0.5, 0.0, 0.0)
        expected = track.step(moved, answer(x).hypotheses, 0.9, 0.0)
        sessions.tracked("another", moved, answer(9.0))
        assert sessions.tracked("robot-7", moved, answer(x)) == expected.document()


def test_without_a_pose_there_is_nothing_to_say() -> None:
    tracked = Sessions().tracked("robot", STILL, Answer((), None, 0.0))
    assert tracked == {
        "pose": None,
        "confidence": 0.0,
        "known": 0.0,
        "known_spread": None,
        "questions": 1,
    }


def test_the_longest_silent_is_forgotten_when_there_are_too_many() -> None:
    clock = Clock()
    sessions = Sessions(clock, most=2)
    for name in ("a", "b", "a", "c"):
        clock.now += 1.0
        questions(sessions, name)
    assert len(sessions) == 2
    assert questions(sessions, "a") == 3
    assert questions(sessions, "b") == 1, "b was silent for longer than a"


def test_a_silent_session_is_forgotten() -> None:
    clock = Clock()
    sessions = Sessions(clock)
    questions(sessions, "a")
    clock.now += SILENT_S / 2
    questions(sessions, "b")
    clock.now += SILENT_S / 2
    assert len(sessions) == 1
    assert questions(sessions, "b") == 2
    assert questions(sessions, "a") == 1


def test_many_threads_lose_no_question() -> None:
    sessions = Sessions()
    threads = [
        threading.Thread(target=lambda: [questions(sessions, "a") for _ in range(10)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert questions(sessions, "a") == 41


@pytest.mark.parametrize("name", ["r", "☕" * MAX_NAME, "\ud800", None])
def test_names(name: str | None) -> None:
    assert session_name(name) == name
    if name is not None:
        assert questions(Sessions(), name) == 1


@pytest.mark.parametrize("name", ["", "x" * (MAX_NAME + 1), 7, ["a"], {}, True])
def test_what_is_no_name_is_refused(name: object) -> None:
    with pytest.raises(QuestionError, match="give a name of 1 to 128 characters"):
        session_name(name)
