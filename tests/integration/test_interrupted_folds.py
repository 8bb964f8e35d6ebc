"""Ctrl-C at any moment of a question: the next answer is that of a fresh fold."""

import gc
import random
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mapfold import Settings, Timeline, fold, open_log

from eventsrc.envelope.system_events import REJECTED_KEY, RejectedPayload
from eventsrc.log import LogReader, LogWriter
from projections.fold.map_errors import FoldInterrupted
from projections.map.digest import map_digest
from projections.map.parsing import read_corrections
from projections.postgres.live_fold import LiveFold
from projections.postgres.queries.live_view import LiveView
from projections.surfaces.serve.asked import ChangesQuery, FindQuery, ServedLog
from projections.surfaces.ui.log_map import LogMap, Opened
from projections.surfaces.ui.map_answers import history_columns
from tests.property.test_timeline_cache import kept_early
from tests.support.commands import interrupt, moments_of
from tests.support.evidence_drives import EVIDENCE
from tests.support.logs import append_command, bridge, keep_apart, name_place, walk, write_log
from tests.support.thorough import mostly_slow, rounds

CLASSIC = Settings(eps_m=0.8, min_samples=3)
ROOMS = Settings(places="rooms")
EACH = [CLASSIC, ROOMS, EVIDENCE]
RULES = pytest.mark.parametrize("rules", mostly_slow(EACH), ids=["page", "rooms", "evidence"])
FIRST, SECOND = walk(36), [*walk(12, seed=3, first=36), *bridge()]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = write_log(tmp_path / "log", FIRST)
    append_command(path, name_place(2, "hall"))
    return path


def grow(log: Path) -> None:
    append_command(log, keep_apart(0, 9))
    write_log(log, SECOND)


def answers(timeline: Timeline) -> list[Any]:
    """What a timeline says, at its end first."""
    ends = (timeline.end, timeline.end // 2, timeline.end - 3)
    digests = [timeline.at(end).digest for end in ends]
    return [*digests, timeline.merges(), timeline.diff(ends[1], ends[0])]


def fresh(log: Path, rules: Settings) -> list[Any]:
    """The same from folds of their own."""
    with Timeline(log, rules, cache=False) as timeline:
        found = answers(timeline)
        ends = (timeline.end, timeline.end // 2, timeline.end - 3)
    assert found[:3] == [fold(log, at=end, settings=rules).digest for end in ends]
    return found


def in_each_event(work: Callable[[], object], seed: int) -> list[int]:
    """A moment in the fold of each event of some work, or of some of them, and a few before, in
    between and after."""
    rng = random.Random(seed)
    found = moments_of(work, mark="fold_parsed")
    assert found.marks
    events = [rng.randrange(a, b) for a, b in zip(found.marks, found.marks[1:], strict=False)]
    events = rng.sample(events, rounds(len(events), 4))
    return [*events, *(rng.randrange(1, found.count + 1) for _ in range(rounds(100, 4)))]


@pytest.mark.parametrize("rules", EACH, ids=["page", "rooms", "evidence"])
def test_an_interrupted_question_can_be_asked_again(log: Path, rules: Settings) -> None:
    expected = fresh(log, rules)

    def ask() -> None:
        with Timeline(log, rules, cache=False) as timeline:
            answers(timeline)

    for moment in in_each_event(ask, seed=1):
        with Timeline(log, rules, cache=False) as timeline:
            interrupt(lambda: answers(timeline), moment)
            assert answers(timeline) == expected, moment
    assert gc.isenabled()


@RULES
def test_a_question_that_is_interrupted_again_and_again(log: Path, rules: Settings) -> None:
    expected, rng = fresh(log, rules), random.Random(2)
    with Timeline(log, rules, cache=False) as timeline:
        for _ in range(rounds(100, 10)):
            interrupt(lambda: answers(timeline), rng.randrange(1, 15_000))
        assert answers(timeline) == expected


@RULES
def test_a_log_that_grows_between_interrupted_questions(log: Path, rules: Settings) -> None:
    before = fresh(log, rules)
    opened = [Timeline(log, rules, cache=False) for _ in range(rounds(60, 4) + 1)]
    assert [answers(each) for each in opened] == [before] * len(opened)
    grow(log)
    expected = fresh(log, rules)

    def ask(timeline: Timeline) -> None:
        timeline.refresh()
        answers(timeline)

    counted = opened.pop()
    for timeline, moment in zip(opened, in_each_event(lambda: ask(counted), 3), strict=False):
        interrupt(lambda: ask(timeline), moment)  # noqa: B023
        ask(timeline)
        assert answers(timeline) == expected, moment


@RULES
def test_the_history_beside_the_log_is_whole_after_an_interrupt(log: Path, rules: Settings) -> None:
    expected = fresh(log, rules)
    rng = random.Random(4)

    def ask() -> None:
        with Timeline(log, rules) as timeline:
            answers(timeline)

    with kept_early():
        folder = log.with_name("log.history")
        for _ in range(rounds(60, 6)):
            for path in folder.glob("*"):
                path.unlink()
            interrupt(ask, rng.randrange(1, 25_000))
            assert not list(folder.glob("*.new"))
            with Timeline(log, rules) as timeline:
                assert answers(timeline) == expected


@RULES
def test_an_interrupted_fold_leaves_nothing_to_the_next_one(log: Path, rules: Settings) -> None:
    expected = fold(log, settings=rules).digest
    with open_log(log) as reader:
        for moment in in_each_event(lambda: fold(reader, settings=rules), seed=5):
            interrupt(lambda: fold(reader, settings=rules), moment)
            assert fold(reader, settings=rules).digest == expected


@RULES
def test_an_interrupted_live_fold_goes_on_rightly_or_refuses(log: Path, rules: Settings) -> None:
    grow(log)
    expected = fold(log, settings=rules).digest
    with LogReader(log) as reader:
        events, corrections = list(reader.read()), read_corrections(reader)

    def feed(live: LiveFold) -> None:
        rest = events[live.map.next_offset :]
        assert list(live.feed(rest)) == [None] * len(rest)

    def new() -> LiveFold:
        return LiveFold(rules, corrections=corrections)

    moments, refused = in_each_event(lambda: feed(new()), seed=6), 0
    for moment in moments:
        live = new()
        interrupt(lambda: feed(live), moment)  # noqa: B023
        try:
            feed(live)
        except FoldInterrupted:
            refused += 1
        else:
            assert map_digest(live.view) == expected
    assert refused


@RULES
def test_the_map_of_the_page_is_right_after_an_interrupted_refresh(
    log: Path, rules: Settings
) -> None:
    opened = [LogMap(Opened(log, lambda _: rules, cache=False)) for _ in range(rounds(60, 4) + 1)]
    for each in opened:
        each.refresh()
    grow(log)
    with LogWriter(log) as writer:
        for _ in range(20):
            writer.append(REJECTED_KEY, RejectedPayload.encode("k", "no JSON", b"?"))

    def shown(page: LogMap) -> list[Any]:
        page.refresh()
        marks = page.log_events
        columns = repr(history_columns(page.timeline.history, 0, marks))
        return [page.key, columns, marks.events, marks.rejected, page.problems]

    with LogMap(Opened(log, lambda _: rules, cache=False)) as page:
        expected = shown(page)
    moments = in_each_event(lambda: shown(opened.pop()), seed=7)
    counted = moments_of(lambda: shown(opened[0]), mark="_rejected")
    moments[-2:] = counted.marks[3], counted.marks[18]
    for page, moment in zip(opened[1:], moments[::-1], strict=False):
        with page:
            interrupt(lambda: shown(page), moment)  # noqa: B023
            assert shown(page) == expected, moment


def test_a_served_log_answers_rightly_after_an_interrupted_question(log: Path) -> None:
    grow(log)
    with LogReader(log) as reader:
        view = LiveView(EVIDENCE)
        view.log_id = reader.log_id
        view.advance(reader.next_offset)

    def ask(beside: ServedLog) -> list[Any]:
        past = beside.find(view, FindQuery(at="30"))
        now = beside.find(view, FindQuery(all="true", limit=100))
        return [past, now, beside.changes(view, ChangesQuery(since="20"))]

    with closing(ServedLog(log)) as beside:
        expected = ask(beside)
    kept = log.with_name("log.history")

    def ask_without_history() -> list[Any]:
        for path in kept.glob("*"):
            path.unlink()
        with closing(ServedLog(log)) as beside:
            return ask(beside)

    for moment in in_each_event(ask_without_history, seed=8):
        for path in kept.glob("*"):
            path.unlink()
        with closing(ServedLog(log)) as beside:
            interrupt(lambda: ask(beside), moment)
            assert ask(beside) == expected, moment
