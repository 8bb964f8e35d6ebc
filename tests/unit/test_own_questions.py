"""The map's own questions: what is taken out of it, and what is asked."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import projections.localize.evaluate.own_questions as own
from eventsrc.envelope.ingest import Accepted, ingest_all
from projections.fold.settings import Settings
from projections.localize.evaluate.questions import spread
from projections.localize.relocalize import ExactIndex, MapCandidates, QuestionCrop
from projections.map.view import MapView
from scripts.programs.bench.truth.folding import fold_into
from tests.support.envelopes import payload
from tests.support.seen_rooms import drive


def _view(*runs: tuple[str, int], seed: int = 3) -> MapView:
    documents = [document for run_id, count in runs for document in drive(seed, run_id, count)]
    accepted = [e for e in ingest_all([*map(payload, documents)]) if isinstance(e, Accepted)]
    view = MapView(Settings(fusion="evidence"))
    for _ in fold_into(view, accepted):
        pass
    return view


@pytest.fixture(scope="module")
def view() -> MapView:
    return _view(("run-a", 70), ("run-b", 50))


class _Recorder(ExactIndex):
    """Records each search: the crops, what was taken out, and the result."""

    searches: list[tuple[list[str], set[int], MapCandidates]]

    def search(self, crops, neighbours=64, without=()):  # type: ignore[no-untyped-def]
        found = super().search(crops, neighbours, without)
        self.searches.append(([c.det_id for c in crops], set(without), found))
        return found


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], set[int], MapCandidates]]:
    """What every search of the index was given and gave."""
    found: list[tuple[list[str], set[int], MapCandidates]] = []
    monkeypatch.setattr(_Recorder, "searches", found, raising=False)
    monkeypatch.setattr(own, "ExactIndex", _Recorder)
    return found


def _is_one(view: MapView, a: int, b: int) -> bool:
    one, other = view.objects[a], view.objects[b]
    assert one.estimate is not None
    assert other.estimate is not None
    ends = ((e.est_x, e.est_y) for e in (one.estimate, other.estimate))
    near = 4.0 if 1 in (one.estimate.spots, other.estimate.spots) else 2.0
    return a == b or (one.class_name == other.class_name and math.dist(*ends) < near)


def test_the_visit_is_taken_out_and_then_the_things_too(view, searches) -> None:
    """Oracle: every observation of the map, one after the other."""
    answers = list(own.ask_own_questions(view, 2, most=15))
    assert len(answers) == len(searches) == 30
    by_id = {o.det_id: o for o in view.observations}
    for number, (answer, (det_ids, without, found)) in enumerate(
        zip(answers, searches, strict=True)
    ):
        seen = [by_id[det_id] for det_id in det_ids]
        asked_from = view.keyframes[seen[0].keyframe]
        visit, things = set(), {o.object for o in seen}
        for observation in view.observations:
            keyframe = view.keyframes[observation.keyframe]
            apart = abs(keyframe.keyframe_id - asked_from.keyframe_id)
            if keyframe.run_id == asked_from.run_id and apart <= own.VISIT:
                visit.add(observation.ordinal)
        shown = {
            o.ordinal
            for o in view.observations
            if any(o.object is not None and _is_one(view, o.object, thing) for thing in things)
        }
        assert answer.taken_out == bool(number % 2)
        assert without == (visit | shown if answer.taken_out else visit)
        assert answer.known == (not answer.taken_out and bool(shown - visit))
        assert {m.observation for row in found.matches for m in row}.isdisjoint(without)
        assert {o.keyframe for o in seen} == {asked_from.ordinal}


def test_a_search_without_some_observations_is_that_of_a_map_without_them(view) -> None:
    index = ExactIndex(view)
    first = view.observations[0]
    assert first.embedding is not None
    crop = QuestionCrop(first.embedding / np.float32(1 << 20))
    every = index.search([crop], len(view.observations)).matches[0]
    without = {m.observation for m in every[::3]}
    left = index.search([crop], 7, without).matches[0]
    assert left == tuple(m for m in every if m.observation not in without)[:7]
    assert index.search([crop], 7, {m.observation for m in every}).matches == ((),)
    assert index.search([crop], 7, ()).matches[0] == every[:7]


def test_cosines_of_its_own_run_are_lowered_by_the_session_shift(view, monkeypatch) -> None:
    ranked: list[MapCandidates] = []
    real = own.rank
    monkeypatch.setattr(
        own, "rank", lambda crops, found, **k: ranked.append(found) or real(crops, found, **k)
    )
    (answer, _) = own.ask_own_questions(view, 1, most=1)
    index = ExactIndex(view)
    constants = index.constants
    keyframe = next(
        k
        for k in view.keyframes
        if any(view.observations[o].embedding is not None for o in k.observations)
    )
    plain = {
        m.observation: m
        for m in index.search(
            [own._crop(view.observations[own._drawn(view, keyframe, 1, own.DEFAULT_SEED)[0]])],
            len(view.observations),
        ).matches[0]
    }
    lowered = constants.evidence.session_shift * (1.0 - constants.different)
    assert lowered > 0.01
    for match in ranked[0].matches[0]:
        off = plain[match.observation].similarity - match.similarity
        assert off == pytest.approx(lowered if match.run_id == keyframe.run_id else 0.0)
    similarities = [m.similarity for m in ranked[0].matches[0]]
    assert similarities == sorted(similarities, reverse=True)
    assert answer.best_cosine == similarities[0]


def test_known_things_are_found_and_taken_out_ones_are_not(view) -> None:
    answers = list(own.ask_own_questions(view, 3, most=30))
    known = [a for a in answers if a.known]
    gone = [a for a in answers if a.taken_out]
    assert len(known) >= 20
    assert not any(a.known or a.correct for a in gone)
    assert np.median([a.error_m for a in known if a.error_m is not None]) < 1.0
    assert np.mean([a.answer.known for a in known]) > 0.5 > np.mean([a.answer.known for a in gone])


def test_a_map_of_one_visit_knows_nothing_of_its_own() -> None:
    answers = list(own.ask_own_questions(_view(("run-a", 15)), 1))
    assert answers
    assert not any(a.known for a in answers)
    assert all(a.answer.pose is None and a.best_cosine == -1.0 for a in answers)
    assert list(own.ask_own_questions(MapView(Settings()), 1)) == []


@given(st.lists(st.integers(), max_size=30), st.integers(0, 40))
@settings(deadline=None)
def test_a_spread_keeps_order_and_reaches_over_everything(items: list[int], most: int) -> None:
    numbered = list(enumerate(items))
    kept = spread(numbered, most)
    assert len(kept) == min(most, len(items))
    assert kept == sorted(set(kept))
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(kept)]
    assert not gaps or max(gaps) - min(gaps) <= 1
