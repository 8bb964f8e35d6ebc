"""Located-in: an Object is in the place where most of its observations were made.

One observation is one vote for the place of its keyframe, as labelled now; noise does not vote, and
votes once it is promoted. Ties go to the place founded first. An Object none of whose observations
has a place is nowhere.
"""

from eventsrc.envelope import Offset
from projections.deltas import ObjectMoved
from projections.reducers import State


class LocatedIn:
    """The reducer. Tell it what happened, in order; then ask what moved."""

    def __init__(self) -> None:
        self.votes: list[dict[int, int]] = []  # per Object: place → observations there
        self.located: list[int | None] = []
        self.voters: dict[int, dict[int, None]] = {}  # place → Objects with votes there
        self.waiting: dict[int, list[int]] = {}  # keyframe without a place → Objects it saw
        self._touched: dict[int, None] = {}

    def places_merged(self, survivor: int, absorbed: tuple[int, ...]) -> None:
        """The votes for the absorbed places are votes for the survivor now."""
        for place in absorbed:
            voters = self.voters.pop(place, {})
            for seen in voters:
                votes = self.votes[seen]
                votes[survivor] = votes.get(survivor, 0) + votes.pop(place)
            self._touched.update(voters)
            if voters:
                self.voters.setdefault(survivor, {}).update(voters)

    def keyframe_placed(self, keyframe: int, place: int) -> None:
        """A keyframe that had no place has one: what it saw can vote."""
        for seen in self.waiting.pop(keyframe, ()):
            self._vote(seen, place)

    def object_seen(self, seen: int, keyframe: int, place: int | None) -> None:
        """The Object was observed from a keyframe, which is in ``place`` or, so far, in none."""
        if seen == len(self.votes):
            self.votes.append({})
            self.located.append(None)
        if place is None:
            self.waiting.setdefault(keyframe, []).append(seen)
        else:
            self._vote(seen, place)

    def settle(self, offset: Offset) -> list[ObjectMoved]:
        """Decide again for every Object whose votes changed; those that moved, ascending."""
        if not self._touched:
            return []
        moved = []
        for seen in sorted(self._touched):
            place = _winner(self.votes[seen])
            if place != self.located[seen]:
                self.located[seen] = place
                moved.append(ObjectMoved(offset, seen, place))
        self._touched.clear()
        return moved

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {
            "votes": [list(map(list, votes.items())) for votes in self.votes],
            "located": self.located,
            "waiting": [[keyframe, seen] for keyframe, seen in self.waiting.items()],
        }

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self.votes = [dict(votes) for votes in state["votes"]]
        self.located = state["located"]
        self.waiting = dict(state["waiting"])
        for seen, votes in enumerate(self.votes):
            for place in votes:
                self.voters.setdefault(place, {})[seen] = None

    def _vote(self, seen: int, place: int) -> None:
        votes = self.votes[seen]
        votes[place] = votes.get(place, 0) + 1
        if self.located[seen] == place and seen not in self._touched:
            return  # it is there already, and one more vote for it cannot change that
        self.voters.setdefault(place, {})[seen] = None
        self._touched[seen] = None


def _winner(votes: dict[int, int]) -> int | None:
    if len(votes) == 1:
        return next(iter(votes))
    return min(votes, key=lambda place: (-votes[place], place), default=None)
