"""Label evidence: the log-likelihood ratio of a label, given the labels that a thing had before."""

from collections.abc import Iterable

from . import State
from .agreement import log_of
from .things import Thing

LABEL_WEIGHT = 0.5
"""The share of a label's log-likelihood ratio that counts, since errors in the labels of one thing
are correlated."""
_DOUBT = 0.3
"""The number of observations with the usual mix of labels that are added to those of a thing."""


class LabelCounts:
    """How often each label occurs."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._total = 0

    def learn(self, labels: Iterable[str]) -> None:
        """Count the labels of a picture."""
        for label in labels:
            self._counts[label] = self._counts.get(label, 0) + 1
            self._total += 1

    def ratio(self, thing: Thing, label: str, usual: float) -> float:
        """The logarithm of the label's probability for the thing, over its ``usual`` one."""
        own = (thing.classes.get(label, 0) + _DOUBT * usual) / (thing.count + _DOUBT)
        return log_of(own / usual)

    def usual(self, label: str) -> float:
        """The label's probability among all observations."""
        return (self._counts.get(label, 0) + 1.0) / (self._total + 10.0)

    def dump(self) -> State:
        """The whole state, for a snapshot."""
        return {"counts": sorted(map(list, self._counts.items()))}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._counts = dict(state["counts"])
        self._total = sum(self._counts.values())
