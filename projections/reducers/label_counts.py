"""How much a label speaks for a thing: labels flicker, so agreement is evidence and no gate."""

from collections.abc import Iterable

from projections.exact_functions import log
from projections.reducers import State

from .things import Thing

_DOUBT = 0.1
"""How many observations of the labels' usual mix are added to those of a thing."""


class LabelCounts:
    """How often each label occurs."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._total = 0

    def learn(self, labels: Iterable[str]) -> None:
        """Take in a picture."""
        for label in labels:
            self._counts[label] = self._counts.get(label, 0) + 1
            self._total += 1

    def ratio(self, thing: Thing, label: str) -> float:
        """log of how probable the label is for the thing, over how frequent it is."""
        usual = (self._counts.get(label, 0) + 1.0) / (self._total + 10.0)
        own = (thing.classes.get(label, 0) + _DOUBT * usual) / (thing.count + _DOUBT)
        return log(own / usual)

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {"counts": sorted(map(list, self._counts.items()))}

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self._counts = dict(state["counts"])
        self._total = sum(self._counts.values())
