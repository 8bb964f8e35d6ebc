"""How much a label speaks for a thing: labels flicker, so agreement is evidence and no gate."""

from collections.abc import Iterable, Sequence

import numpy as np

from projections.reducers import State

from .agreement import logs
from .looks import Floats
from .things import Thing

_DOUBT = 0.3
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

    def ratios(self, things: Sequence[Thing], labels: Sequence[str]) -> Floats:
        """For each pair, log of the label's probability for the thing, over its usual one."""
        counts = [thing.count for thing in things]
        same = [thing.classes.get(label, 0) for thing, label in zip(things, labels, strict=True)]
        usual = np.array([self._counts.get(label, 0) for label in labels]) + 1.0
        usual /= self._total + 10.0
        own = (np.array(same) + _DOUBT * usual) / (np.array(counts) + _DOUBT)
        return logs(own / usual)

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {"counts": sorted(map(list, self._counts.items()))}

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self._counts = dict(state["counts"])
        self._total = sum(self._counts.values())
