"""Questions to `mapfold serve` over Zenoh: a router, a database, clients that ask at once."""

import json
import threading
from collections.abc import Callable, Iterator

import pytest

from eventsrc.record.transport.session import Session
from projections.localize.relocalize import parse_question
from projections.localize.relocalize.track import Track
from projections.postgres.connection import Targets, connect
from projections.postgres.queries.candidate_search import relocalize
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from tests.support.serve_questions import (
    DEADLINE_S,
    FORMS,
    OTHER_SPACE,
    ask,
    question,
    tracked_question,
)
from tests.support.thorough import rounds


@pytest.fixture
def service(
    connected: Callable[[], Session], answerer: Answerer, queue: FairQueue
) -> Iterator[ZenohService]:
    with ZenohService(connected(), answerer, queue) as service:
        yield service


@pytest.mark.usefixtures("service")
def test_the_answer_equals_the_librarys(
    connected: Callable[[], Session], walked_map: Targets
) -> None:
    good, answer = ask(connected(), "mapfold/relocalize", question())
    assert good
    assert answer == relocalize(walked_map, parse_question(question())).document()


@pytest.mark.usefixtures("service")
@pytest.mark.parametrize("form", FORMS)
def test_views_classes_and_texts_are_answered(
    connected: Callable[[], Session], walked_map: Targets, form: str
) -> None:
    good, answer = ask(connected(), "mapfold/relocalize", FORMS[form])
    assert good
    assert answer == relocalize(walked_map, parse_question(FORMS[form])).document()
    assert answer["places"]


@pytest.mark.usefixtures("service")
def test_a_session_is_tracked(connected: Callable[[], Session], walked_map: Targets) -> None:
    track, session = Track("robot-7"), connected()
    for number in range(4):
        moved = (0.25 * number, 0.0, 0.125)
        asked = tracked_question(number, moved, "robot-7")
        answer = relocalize(walked_map, parse_question(asked))
        tracked = track.step(
            moved, answer.hypotheses, answer.confidence, answer.known, answer.looks
        )
        expected = answer.document() | {"track": tracked.document()}
        assert ask(session, "mapfold/relocalize", asked) == (True, expected)
    assert expected["track"]["questions"] == 4
    good, other = ask(session, "mapfold/relocalize?session=robot-8", question())
    assert good
    assert other["track"]["questions"] == 1


@pytest.mark.usefixtures("service")
def test_an_unknown_class_is_named_with_the_nearest(connected: Callable[[], Session]) -> None:
    good, answer = ask(connected(), "mapfold/relocalize", b'[{"class": "baker rack"}]')
    assert not good
    assert "no object of class 'baker rack'; similar ones: baker's rack" in str(answer)


@pytest.mark.usefixtures("service")
def test_a_bad_question_gets_an_error_as_reply(connected: Callable[[], Session]) -> None:
    session = connected()
    one_of_nan = b'{"dx": 1, "dy": NaN, "dyaw": 0, "crops": [{"class": "a"}]}'
    for selector, payload in (
        ("mapfold/relocalize", b"nonsense"),
        ("mapfold/relocalize", None),
        ("mapfold/relocalize?top=0", question()),
        ("mapfold/relocalize", b'{"session": 7, "crops": [{"class": "a"}]}'),
        ("mapfold/relocalize?session=a", one_of_nan),
        ("mapfold/relocalize", b"[" * 2_000_000),
        ("mapfold/relocalize", OTHER_SPACE),
        ("mapfold/state/places?x=0", None),
        ("mapfold/state/places?X=0;Y=0", None),
        ("mapfold/state/places?radius=3", None),
        ("mapfold/state/places?cursor=a", None),
        ("mapfold/state/places?cursor=0;x=0;y=0", None),
        ("mapfold/state/objects?limit=0", None),
        ("mapfold/state/objects?limit=1001", None),
        ("mapfold/state/secrets?x=0;y=0", None),
    ):
        good, answer = ask(session, selector, payload)
        assert not good, selector
        assert answer["error"]["kind"] == "bad_question", selector
        assert answer["error"]["message"], selector


@pytest.mark.usefixtures("service")
@pytest.mark.parametrize("selector", ["mapfold/state/places", "mapfold/state/secrets"])
def test_replies_have_the_encoding_of_json(connected: Callable[[], Session], selector: str) -> None:
    (reply,) = connected().raw.get(selector, timeout=DEADLINE_S)
    answer = reply.ok or reply.err
    assert answer is not None
    assert str(answer.encoding) == "application/json"


@pytest.mark.usefixtures("service")
def test_parameters_of_zenoh_are_passed_over(connected: Callable[[], Session]) -> None:
    session = connected()
    assert ask(session, "mapfold/state/places?_time=[..]") == ask(session, "mapfold/state/places")


@pytest.mark.usefixtures("service")
def test_state_near_a_pose(connected: Callable[[], Session], pools: Pools) -> None:
    session = connected()
    good, found = ask(session, "mapfold/state/places?x=0;y=0;radius=1000")
    assert good
    distances = [place["distance_m"] for place in found["places"]]
    assert distances
    assert distances == sorted(distances)
    x, y = (found["places"][0][f"centroid_{axis}"] for axis in "xy")
    _, near = ask(session, f"mapfold/state/places?x={x};y={y};radius=0.01")
    assert [p["place_id"] for p in near["places"]] == [found["places"][0]["place_id"]]
    _, objects = ask(session, "mapfold/state/objects?x=0;y=0;radius=1000")
    assert {"object_id", "class_name", "distance_m"} <= set(objects["objects"][0])


@pytest.mark.usefixtures("service")
def test_eight_clients_at_once_get_their_own_answers(
    connected: Callable[[], Session], walked_map: Targets
) -> None:
    expected = [relocalize(walked_map, parse_question(question(n))).document() for n in range(8)]
    wrong: list[object] = []

    def client(session: Session, number: int) -> None:
        for _ in range(rounds(5, 2)):
            good, answer = ask(session, "mapfold/relocalize", question(number))
            if not good or answer != expected[number]:
                wrong.append(answer)

    threads = [threading.Thread(target=client, args=(connected(), n)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.usefixtures("service")
def test_a_broken_connection_costs_no_answer(
    connected: Callable[[], Session], walked_map: Targets
) -> None:
    session = connected()
    assert ask(session, "mapfold/relocalize", question())[0]
    with connect(walked_map.graph_url, autocommit=True) as killer:
        killer.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE application_name = 'mapfold serve' AND datname = current_database()"
        )
    assert ask(session, "mapfold/relocalize", question())[0]


def test_a_closed_service_has_answered_queued_questions(
    connected: Callable[[], Session], answerer: Answerer
) -> None:
    session, answers = connected(), []
    queue = FairQueue(1, max_wait_s=DEADLINE_S)
    service = ZenohService(connected(), answerer, queue)
    threads = [
        threading.Thread(
            target=lambda: answers.extend(
                session.get_replies("mapfold/relocalize", question(), timeout_s=DEADLINE_S)
            )
        )
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    service.close()
    service.close()
    queue.close()
    for thread in threads:
        thread.join()
    assert all(json.loads(answer) for _, answer in answers)
    assert session.get_replies("mapfold/relocalize", question(), timeout_s=1.0) == []
