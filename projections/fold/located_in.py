"""Located-in: an Object is in the place where most of its observations were made.

One observation is one vote for the place of its keyframe, as labelled now; noise does not vote, and
votes once it is promoted. Ties go to the place founded first. An Object none of whose observations
has a place is nowhere. The votes of an absorbed Object are its survivor's. An Object that was
relocated to where another was found, and absorbs that, has only the votes of the absorbed one.
"""

from eventsrc.envelope.model import Offset

from . import State
from .deltas import KeyframeOrdinal, ObjectMoved, ObjectOrdinal, PlaceOrdinal
from .survivors import ObjectSurvivors


class LocatedIn:
    """The reducer of located-in. Merges, placings and sightings are reported to it in order, before
    `collect_moves`."""

    def __init__(self) -> None:
        self.votes: list[dict[PlaceOrdinal, int]] = []  # per Object: place → observations there
        self.located: list[PlaceOrdinal | None] = []  # per Object
        # place → Objects with votes there
        self.voters: dict[PlaceOrdinal, dict[ObjectOrdinal, None]] = {}
        # keyframe without a place → Objects it saw
        self.waiting: dict[KeyframeOrdinal, list[ObjectOrdinal]] = {}
        self.survivors = ObjectSurvivors()
        self._touched: dict[ObjectOrdinal, None] = {}

    def places_merged(self, survivor: PlaceOrdinal, absorbed: tuple[PlaceOrdinal, ...]) -> None:
        """Count the votes for absorbed places for the survivor."""
        for place in absorbed:
            voters = self.voters.pop(place, {})
            for ordinal in voters:
                votes = self.votes[ordinal]
                votes[survivor] = votes.get(survivor, 0) + votes.pop(place)
            self._touched.update(voters)
            if voters:
                self.voters.setdefault(survivor, {}).update(voters)

    def objects_merged(self, survivor: ObjectOrdinal, absorbed: ObjectOrdinal) -> None:
        """Count the absorbed Object's votes, later ones too, for the survivor."""
        self.survivors.merge(survivor, (absorbed,))
        votes, others = self.votes[survivor], self.votes[absorbed]
        self.votes[absorbed], self.located[absorbed] = {}, None
        for place, count in others.items():
            votes[place] = votes.get(place, 0) + count
            del self.voters[place][absorbed]
            self.voters[place][survivor] = None
        self._touched.pop(absorbed, None)
        if others:
            self._touched[survivor] = None

    def keyframe_placed(self, keyframe: KeyframeOrdinal, place: PlaceOrdinal) -> None:
        """Count the votes of the Objects seen by a keyframe that had no place until now."""
        for ordinal in self.waiting.pop(keyframe, ()):
            self._vote(self.survivors.find(ordinal), place)

    def object_seen(
        self, ordinal: ObjectOrdinal, keyframe: KeyframeOrdinal, place: PlaceOrdinal | None
    ) -> None:
        """Count a vote of an Object observed from a keyframe that is in ``place``, or so far in
        none."""
        if ordinal == len(self.votes):
            self.votes.append({})
            self.located.append(None)
        if place is None:
            self.waiting.setdefault(keyframe, []).append(ordinal)
        else:
            self._vote(ordinal, place)

    def object_left(self, ordinal: ObjectOrdinal) -> None:
        """Drop the votes of an Object that was relocated, also pending ones of earlier
        keyframes."""
        for voted in self.votes[ordinal]:
            del self.voters[voted][ordinal]
        self.votes[ordinal] = {}
        self._touched[ordinal] = None
        for keyframe, waiting in list(self.waiting.items()):
            kept = [each for each in waiting if self.survivors.find(each) != ordinal]
            if kept:
                self.waiting[keyframe] = kept
            else:
                del self.waiting[keyframe]

    def collect_moves(self, offset: Offset) -> list[ObjectMoved]:
        """Recount the Objects whose votes changed; returns those that moved, ascending."""
        if not self._touched:
            return []
        moved = []
        for ordinal in sorted(self._touched):
            place = _winner(self.votes[ordinal])
            if place != self.located[ordinal]:
                self.located[ordinal] = place
                moved.append(ObjectMoved(offset, ordinal, place))
        self._touched.clear()
        return moved

    def dump(self) -> State:
        """The whole state, for a snapshot."""
        return {
            "votes": [list(map(list, votes.items())) for votes in self.votes],
            "located": self.located,
            "waiting": [
                [keyframe, [*map(self.survivors.find, ordinals)]]
                for keyframe, ordinals in self.waiting.items()
            ],
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self.votes = [dict(votes) for votes in state["votes"]]
        self.located = state["located"]
        self.waiting = dict(state["waiting"])
        for ordinal, votes in enumerate(self.votes):
            for place in votes:
                self.voters.setdefault(place, {})[ObjectOrdinal(ordinal)] = None

    def _vote(self, ordinal: ObjectOrdinal, place: PlaceOrdinal) -> None:
        votes = self.votes[ordinal]
        votes[place] = votes.get(place, 0) + 1
        if self.located[ordinal] == place and ordinal not in self._touched:
            return  # one more vote for its own place cannot move it
        self.voters.setdefault(place, {})[ordinal] = None
        self._touched[ordinal] = None


def _winner(votes: dict[PlaceOrdinal, int]) -> PlaceOrdinal | None:
    if len(votes) == 1:
        return next(iter(votes))
    return min(votes, key=lambda place: (-votes[place], place), default=None)
