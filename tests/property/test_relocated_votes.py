"""Located-in where Objects merge and stand elsewhere, against votes recounted at each step."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeOrdinal, ObjectOrdinal, PlaceOrdinal
from projections.fold.pair_groups import PlaceSurvivors
from projections.fold.relations import LocatedIn
from projections.fold.standing import Standing

STEPS = st.lists(
    st.tuples(
        st.sampled_from(["see", "see", "place", "merge", "join", "relocate"]),
        st.integers(0, 5),
        st.integers(0, 5),
        st.none() | st.integers(0, 2),
    ),
    max_size=30,
)


class Recount:
    """Every vote as (Object, keyframe), void ones left out; merges rename."""

    def __init__(self) -> None:
        self.votes: list[tuple[int, int]] = []
        self.place_of: dict[int, int | None] = {}
        self.objects = 0
        self.alive: list[int] = []

    def located(self, ordinal: int) -> int | None:
        cast = (self.place_of[k] for o, k in self.votes if o == ordinal)
        votes = Counter(place for place in cast if place is not None)
        return min(votes, key=lambda place: (-votes[place], place), default=None)


@given(STEPS, st.integers(0, 30))
def test_votes_are_void_when_an_object_stands_elsewhere(
    steps: list[tuple[str, int, int, int | None]], reload_at: int
) -> None:
    located, recount = LocatedIn(Standing(lambda _: None, PlaceSurvivors())), Recount()
    for number, (kind, a, b, place) in enumerate(steps):
        if number == reload_at:
            fresh = LocatedIn(Standing(lambda _: None, PlaceSurvivors()))
            fresh.load(located.dump())
            located = fresh
        keyframe = KeyframeOrdinal(number)
        recount.place_of[number] = place
        at = None if place is None else PlaceOrdinal(place)
        alive = recount.alive
        if kind == "see" or not alive:
            ordinal = a if a in alive else recount.objects
            if ordinal == recount.objects:
                recount.objects += 1
                alive.append(ordinal)
            located.object_seen(ObjectOrdinal(ordinal), keyframe, at)
            recount.votes.append((ordinal, number))
        elif kind == "place":
            waiting = [k for k, found in recount.place_of.items() if found is None and k < number]
            if waiting:
                chosen = waiting[a % len(waiting)]
                recount.place_of[chosen] = b % 3
                located.keyframe_placed(KeyframeOrdinal(chosen), PlaceOrdinal(b % 3))
        elif kind in ("merge", "relocate") and len(alive) > 1:
            one, other = alive[a % len(alive)], alive[b % len(alive)]
            if one != other:
                survivor, absorbed = min(one, other), max(one, other)
                if kind == "relocate":
                    located.object_left(ObjectOrdinal(survivor))
                    recount.votes = [(o, k) for o, k in recount.votes if o != survivor]
                located.objects_merged(ObjectOrdinal(survivor), ObjectOrdinal(absorbed))
                alive.remove(absorbed)
                recount.votes = [(survivor if o == absorbed else o, k) for o, k in recount.votes]
        elif kind == "join":
            located.places_merged(PlaceOrdinal(0), (PlaceOrdinal(2),))
            recount.place_of = {k: 0 if p == 2 else p for k, p in recount.place_of.items()}
        moved = {m.object: m.place for m in located.collect_moves(Offset(number))}
        for ordinal in alive:
            assert located.located[ordinal] == recount.located(ordinal)
            if ordinal in moved:
                assert moved[ordinal] == recount.located(ordinal)
