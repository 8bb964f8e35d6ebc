"""The same question to a log, to its databases and to a service over HTTP and Zenoh gets the same
answer in a house with walls, also after a tail has followed the log to another map."""

import json
import threading
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import psycopg
import pytest

from eventsrc.adapters.sim import build_house
from eventsrc.adapters.sim.house import occupancy_map
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import ALWAYS, LogReader, LogWriter
from eventsrc.record.transport.session import Session
from projections.fold.map_errors import ProjectionMismatch
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, parse_question, rank
from projections.localize.relocalize.ranking import Answer
from projections.map.fold import fold_log
from projections.postgres import TailProgress, rebuild, tail
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader, relocalize
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from projections.surfaces.serve.guard import Guard
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.logs import simulated
from tests.support.scenes import assert_equal
from tests.support.thorough import rounds

WAIT_S = 60.0
SEED = 7
SETTINGS = Settings()


@cache
def _drive(run: str) -> list[bytes]:
    return list(simulated(SEED, run).payloads)


def _questions() -> list[bytes]:
    """What another drive sees, two crops or more."""
    seen = [payload for payload in _drive("b")[:120:4] if payload.count(b'"class"') > 1]
    return seen[: rounds(6, 1)]


@cache
def _house() -> OccupancyMap:
    return occupancy_map(build_house(SEED))


def _other_house() -> OccupancyMap:
    """The house moved by half a metre, so that its walls cut rooms."""
    given = _house()
    return OccupancyMap(None, given.resolution, (0.0, -0.25, 0.0), "moved", given.cells)


def _append(log: Path, *items: OccupancyMap | bytes) -> int:
    with LogWriter(log, fsync=ALWAYS) as writer:
        for item in items:
            if isinstance(item, OccupancyMap):
                writer.append(MAP_KEY, item.encode())
            else:
                writer.append(KEY, item)
        return writer.next_offset


def _exact(log: Path) -> ExactIndex:
    with LogReader(log) as reader:
        return ExactIndex(fold_log(reader, SETTINGS)[1])


class _Services:
    """One question over HTTP and over Zenoh."""

    def __init__(self, port: int, session: Session) -> None:
        self._port, self._session = port, session

    def ask(self, question: bytes) -> list[object]:
        url = f"http://127.0.0.1:{self._port}/relocalize"
        asked = urllib.request.Request(url, question, {"Content-Type": "application/json"})
        with urllib.request.urlopen(asked, timeout=WAIT_S) as reply:
            over_http = json.load(reply)
        replies = self._session.get_replies("mapfold/relocalize", question, timeout_s=WAIT_S)
        ((good, over_zenoh),) = replies
        assert good
        return [over_http, json.loads(over_zenoh)]


@pytest.fixture
def services(
    targets: Targets, connected: Callable[[], Session]
) -> Iterator[Callable[[], _Services]]:
    """Call it once there is a projection; the services run until the end of the test."""
    with ExitStack() as running:

        def start() -> _Services:
            pools = running.enter_context(Pools(targets, 2))
            answerer = Answerer(pools, per_second=10_000.0)
            queue = running.enter_context(FairQueue(2, max_wait_s=WAIT_S))
            app = Guard(create_app(answerer, queue))
            port = running.enter_context(serving(app, bind("127.0.0.1", 0)))
            running.enter_context(ZenohService(connected(), answerer, queue))
            return _Services(port, connected())

        yield start


def _check_answers(log: Path, targets: Targets, services: _Services) -> float:
    """All answers agree; by how many metres walls move them, in the mean."""
    index, moved = _exact(log), []
    with CandidateReader(targets) as reader:
        for question in _questions():
            asked = parse_question(question)
            exact = index.search(asked.crops)
            live = reader.candidates(asked.crops)
            assert_equal(live, exact)
            assert live.walls.keys() == exact.walls.keys()
            ours, theirs = rank(asked, live), rank(asked, exact)
            assert ours.pose is not None
            assert theirs.pose is not None
            assert (ours.pose.x, ours.pose.y) == pytest.approx(
                (theirs.pose.x, theirs.pose.y), abs=1e-4
            )
            assert ours.pose.floor == theirs.pose.floor
            document = relocalize(targets, asked).document()
            assert document == ours.document()
            assert services.ask(question) == [document, document]
            moved.append(_apart(theirs, rank(asked, replace(exact, walls={}))))
    return float(np.mean(moved))


def _apart(one: Answer, other: Answer) -> float:
    assert one.pose is not None
    assert other.pose is not None
    return float(np.hypot(one.pose.x - other.pose.x, one.pose.y - other.pose.y))


def test_walls_count_the_same_wherever_the_question_goes(
    tmp_path: Path, targets: Targets, services: Callable[[], _Services]
) -> None:
    log, drive = tmp_path / "log", _drive("a")
    _append(log, *drive[:100])
    rebuild(log, targets, SETTINGS)
    asked = services()
    assert _check_answers(log, targets, asked) == 0.0, "no map yet"
    stop, progress = threading.Event(), TailProgress()
    following = threading.Thread(
        target=tail, args=(log, targets, SETTINGS), kwargs={"stop": stop, "progress": progress}
    )
    following.start()
    try:
        distances = []
        steps: Sequence[Sequence[OccupancyMap | bytes]] = (
            [_house()],
            [*drive[100:110], _house(), *drive[110:120]],
            [_other_house(), *drive[120:125]],
        )
        for step in steps:
            assert progress.wait(_append(log, *step), WAIT_S)
            distances.append(_check_answers(log, targets, asked))
        assert min(distances) > 0.02, "walls do move answers"
    finally:
        stop.set()
        following.join(WAIT_S)
    rebuild(log, targets, SETTINGS)
    assert _check_answers(log, targets, asked) > 0.02
    empty = replace(_house(), cells=np.zeros_like(_house().cells))
    _append(log, empty)
    tail(log, targets, SETTINGS, once=True)
    assert _check_answers(log, targets, asked) == 0.0, "a map without walls"


@pytest.mark.slow
def test_each_floor_has_its_walls_in_answers(
    tmp_path: Path, targets: Targets, services: Callable[[], _Services]
) -> None:
    """The house on two floors; upstairs another map."""
    log, documents = tmp_path / "log", [json.loads(each) for each in _drive("a")[:90]]
    for number, document in enumerate(documents):
        document["floor"] = "0" if number < 45 else "1"
    upstairs = replace(_other_house(), floor="1")
    _append(log, _house(), upstairs, *map(payload, documents))
    rebuild(log, targets, SETTINGS)
    _check_answers(log, targets, services())
    index = _exact(log)
    asked = parse_question(_questions()[0])
    assert set(index.search(asked.crops).walls) == {"0", "1"}


@pytest.mark.slow
def test_a_tail_refuses_a_projection_whose_table_of_maps_was_dropped(
    tmp_path: Path, one_database: Targets
) -> None:
    log = tmp_path / "log"
    _append(log, _house(), *_drive("a")[:60])
    rebuild(log, one_database, SETTINGS)
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("DROP TABLE mapfold.occupancy_map")
    with pytest.raises(ProjectionMismatch, match=r"no table mapfold\.occupancy_map") as told:
        tail(log, one_database, SETTINGS, once=True)
    assert "run `mapfold replay" in str(told.value)
    rebuild(log, one_database, SETTINGS)
    asked = parse_question(_questions()[0])
    with CandidateReader(one_database) as reader:
        assert list(reader.candidates(asked.crops).walls) == [None]
    _append(log, payload(envelope(9_000, 1.0, 1.0, run_id="late")))
    assert tail(log, one_database, SETTINGS, once=True).events == 1


@pytest.mark.slow
def test_readers_see_the_maps_of_one_projection_or_the_other_during_rebuilds(
    tmp_path: Path, one_database: Targets
) -> None:
    """Questions go on while rebuilds put another map in, take it out, and make the table anew."""
    logs = [tmp_path / name for name in ("plain", "house", "other")]
    maps = [None, _house(), _other_house()]
    for log, given in zip(logs, maps, strict=True):
        _append(log, *([] if given is None else [given]), *_drive("a")[:60])
    rebuild(logs[0], one_database, SETTINGS)
    crops = parse_question(_questions()[0]).crops
    stop = threading.Event()

    def corner(reader: CandidateReader) -> float | None:
        walls = reader.candidates(crops).walls
        return float(walls[None]._corner[1]) if walls else None

    def ask() -> set[float | None]:
        found: set[float | None] = set()
        with CandidateReader(one_database) as reader:
            while not stop.is_set():
                found.add(corner(reader))
        return found

    wanted = [None if given is None else given.origin[1] for given in maps]
    with ThreadPoolExecutor(2) as pool:
        readers = [pool.submit(ask) for _ in range(2)]
        try:
            for number in (1, 2, 0, 1, 2):
                rebuild(logs[number], one_database, SETTINGS)
                with CandidateReader(one_database) as fresh:
                    assert corner(fresh) == wanted[number]
        finally:
            stop.set()
        seen = [reader.result(WAIT_S) for reader in readers]
    assert all(len(each) > 1 and each <= set(wanted) for each in seen)
