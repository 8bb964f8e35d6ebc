"""Ways to the map at W that need no database: timelines new, kept, grown, shared by threads and
interrupted; caches, the map for one question, what-ifs and the map of `mapfold edit`."""

import random
import sys
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.edit.current import MapToEdit
from projections.history import LogTimeline
from projections.history.rule_folds import Rules, fold_all
from projections.map.parsing import read_corrections
from projections.store.history_recorder import map_after
from projections.surfaces import python as api
from tests.support.commands import reports_exceptions
from tests.support.histories import whole

from .outcomes import Chosen, Tally, folded, outcome, stories

_THREADS = 3


class Interrupted(BaseException):
    """What Ctrl-C would raise."""


class TimelineWays:
    """Asks all ways after each growth of a log; a context manager."""

    def __init__(
        self,
        log: Path,
        settings: Chosen,
        rng: random.Random,
        tally: Tally,
        without: Collection[str] = (),
    ) -> None:
        self._without = without
        self._log, self._settings, self._rng, self._tally = log, settings, rng, tally
        self._known: dict[tuple[int, int], Any] = {}
        """Maps by W and V, from when the log ended there."""
        self._told: dict[int, tuple[int, Any]] = {}
        """By W a seed and the stories told with it when the log ended there."""

    def __enter__(self) -> "TimelineWays":
        self._live: LogTimeline | None = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.reader.close()

    def ask(self, end: int) -> None:
        """Ask about the log, which has ``end`` events now."""
        if self._live is None:
            self._live = LogTimeline(self._log, self._settings, cache=False)
        self._live.refresh()
        later = [self._rng.choice([*self._known])] if self._known else []
        drawn = [(self._rng.randint(0, end), self._rng.randint(0, end)) for _ in range(2)]
        points = [(end, end), *drawn, *later]
        expected = {point: self._expected(point) for point in points}
        for point in points:
            self._compare_maps(point, expected[point])
        self._compare_stories(end)
        if "interrupts" not in self._without:
            self._interrupt(points, expected)
        if "threads" not in self._without:
            self._share([w for w, _ in points])

    def _expected(self, point: tuple[int, int]) -> Any:
        found = folded(self._log, self._settings, *point)
        if point in self._known:
            self._tally.compare("a longer log", found, self._known[point], point)
        return self._known.setdefault(point, found)

    def _compare_maps(self, point: tuple[int, int], expected: Any) -> None:
        end, known_at = map(Offset, point)
        assert self._live is not None
        live = self._live
        self._compare("grown timeline", lambda: whole(live.at(end, known_at=known_at)), point)
        for way, cache in (("kept timeline", True), ("new timeline", False)):
            with LogTimeline(self._log, self._settings, cache=cache) as timeline:
                asked = partial(timeline.at, end, known_at=known_at)
                self._compare(way, lambda: whole(asked()), point)  # noqa: B023  # called at once
        with LogReader(self._log) as reader:
            corrections = outcome(lambda: read_corrections(reader, known_at))
            if isinstance(corrections, tuple):  # why they are refused
                self._tally.compare("corrections", corrections, expected, point)
                return
            given = {"corrections": corrections, "note": lambda _: None}
            settings = self._settings(corrections)
            for way, cache in (("one question", True), ("one question, no cache", False)):
                ask = partial(map_after, reader, settings, end, cache=cache, **given)
                self._compare(way, lambda: whole(ask()), point)  # noqa: B023  # called at once
            if end == known_at:
                edited = MapToEdit(reader, self._settings, until=end)
                self._compare("edit", lambda: whole(edited.view), point)
            rules = [Rules(settings, corrections)]
            self._compare(
                "what-if",
                lambda: fold_all(self._log, rules, end, processes=1)[0].digest,
                point,
                lambda state: state["digest"],
            )

    def _compare(
        self,
        way: str,
        ask: Callable[[], Any],
        point: tuple[int, int],
        part: Callable[[Any], Any] = lambda state: state,
    ) -> None:
        expected = self._known[point]
        wanted = part(expected) if isinstance(expected, dict) else expected
        self._tally.compare(way, outcome(ask), wanted, point)

    def _compare_stories(self, end: int) -> None:
        """Stories of the map at the end, and those of one when the log ended earlier."""
        assert self._live is not None
        for at in {end, self._rng.choice([*self._told, end])}:
            seed, expected = self._told.get(at, (self._rng.randrange(10**9), None))
            for way, cache in (("new", False), ("kept", True)):
                with LogTimeline(self._log, self._settings, cache=cache) as timeline:
                    found = self._stories(timeline, at, seed)
                if expected is None:
                    expected = found
                    self._told[at] = seed, found
                self._tally.compare(f"stories, {way}", found, expected, at)
            self._tally.compare("stories, grown", self._stories(self._live, at, seed), expected, at)

    def _stories(self, timeline: LogTimeline, at: int, seed: int) -> Any:
        known = outcome(lambda: timeline.knowing(Offset(at)))
        return known if isinstance(known, tuple) else stories(known, at, random.Random(seed))

    def _interrupt(self, points: list[tuple[int, int]], expected: dict[Any, Any]) -> None:
        """Interrupt a timeline at random calls; what it says afterwards is right."""
        with LogTimeline(self._log, self._settings, cache=self._rng.random() < 0.5) as timeline:
            for end, known_at in points:
                asked = partial(timeline.at, Offset(end), known_at=Offset(known_at))
                ask = partial(outcome, lambda: whole(asked()))  # noqa: B023  # called at once
                interrupt(ask, int(10 ** self._rng.uniform(0.5, 4.5)))
                if self._rng.random() < 0.7:
                    found = ask()
                    self._tally.compare(
                        "interrupted", found, expected[end, known_at], (end, known_at)
                    )

    def _share(self, ends: list[int]) -> None:
        """Ask one timeline of the Python interface from several threads."""
        asked = [self._rng.choice(ends) for _ in range(2 * _THREADS)]
        given = self._settings.otherwise if self._rng.random() < 0.5 else None
        with (
            api.Timeline(self._log, given, cache=self._rng.random() < 0.5) as timeline,
            ThreadPoolExecutor(_THREADS) as pool,
        ):
            digests = [*pool.map(lambda w: outcome(lambda: timeline.at(w).digest), asked)]
        with api.Timeline(self._log, given, cache=False) as timeline:
            alone = {w: outcome(lambda: timeline.at(w).digest) for w in {*asked}}  # noqa: B023
        self._tally.compare("threads", digests, [alone[end] for end in asked], asked)


def interrupt(work: Callable[[], object], calls: int) -> None:
    """Do ``work``, in which the ``calls``-th function call raises; suppress that."""
    left, armed = calls, True

    def counted(frame: FrameType, event: str, _: object) -> None:
        nonlocal left
        left -= armed and event in ("call", "c_call")
        if armed and left <= 0 and not reports_exceptions(frame):
            sys.setprofile(None)
            raise Interrupted

    try:
        sys.setprofile(counted)
        work()
        armed = False
    except BaseException:
        armed = False
        if left > 0:
            raise
        # pydantic makes an error of its own of what is raised in its serializers.
    finally:
        sys.setprofile(None)
