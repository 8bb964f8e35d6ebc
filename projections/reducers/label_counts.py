"""How much a label speaks for a thing: labels flicker, so agreement is evidence and no gate."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from projections.reducers import State

from .agreement import log_of, logs
from .looks import Floats
from .things import Thing

LABEL_WEIGHT = 0.5
"""What counts of a label's log-likelihood ratio: the labels of one thing err together."""
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

    def ratios(
        self, things: Sequence[Thing], labels: Sequence[str]
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """For each pair, log of the label's probability for the thing, over its usual one; and
        whether the thing had the label before."""
        usual_of = {label: self._usual(label) for label in set(labels)}
        counts = np.array([thing.count for thing in things])
        same = np.array(
            [thing.classes.get(label, 0) for thing, label in zip(things, labels, strict=True)]
        )
        usual = np.array([usual_of[label] for label in labels])
        own = (same + _DOUBT * usual) / (counts + _DOUBT)
        return logs(own / usual), same > 0

    def ratio(self, thing: Thing, label: str) -> float:
        """The same of one pair."""
        usual = self._usual(label)
        own = (thing.classes.get(label, 0) + _DOUBT * usual) / (thing.count + _DOUBT)
        return log_of(own / usual)

    def _usual(self, label: str) -> float:
        """The label's probability among all observations."""
        return (self._counts.get(label, 0) + 1.0) / (self._total + 10.0)

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {"counts": sorted(map(list, self._counts.items()))}

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self._counts = dict(state["counts"])
        self._total = sum(self._counts.values())
