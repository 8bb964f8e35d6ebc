"""The state of one Object in fusion by evidence: its observations' sums, its spots, its exemplars;
and the evidence of a label, given the labels that it had before.

Exemplars are looks that are kept to compare new ones with, by side and session: of one run and one
eighth of the directions the newest `_OF_A_KIND`, and `MOST_EXEMPLARS` in all; then the oldest goes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from . import State
from .deltas import ObjectOrdinal
from .exact import log_of
from .looks import Exemplar
from .spots import Estimate, Spots

MOST_EXEMPLARS = 6
_OF_A_KIND = 3
INVERSE, SIDE_COS, SIDE_SIN, RUN = range(4)
KIND: Final = 4
ROW: Final = 5
"""Fields of an exemplar in ``marks``."""

Given = tuple[str, int, int]
"""The values that a thing added: class name, log size and elevation in units of 2⁻¹⁶."""


@dataclass(slots=True, eq=False)
class FusedThing:
    """``classes`` counts observations by class, the class seen first being first. ``marks`` are the
    exemplars, the oldest first; their looks are the first rows of ``looks``. ``met`` counts the
    pictures that show another thing too. ``checked`` is at how many observations the next search
    for a thing to merge with is due. The kind of an exemplar is its run and the eighth of the
    directions."""

    count: int
    sum_x_um: int
    sum_y_um: int
    first_seen: float
    last_seen: float
    class_name: str
    classes: dict[str, int]
    spots: Spots
    looks: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    marks: list[Exemplar] = field(default_factory=list)
    cell: tuple[int, int] = (0, 0)
    met: dict[ObjectOrdinal, int] = field(default_factory=dict)
    checked: int = 2
    given: Given | None = None
    estimate: Estimate | None = None
    groups: set[int] = field(default_factory=set)

    def keep(
        self, look: NDArray[np.float32], inverse: float, cos: float, sin: float, run: int
    ) -> None:
        """Add a look as an exemplar."""
        kind = run * 8 + (cos > 0.0) * 4 + (sin > 0.0) * 2 + (abs(cos) > abs(sin))
        marks = self.marks
        row = len(marks)
        alike = [i for i, mark in enumerate(marks) if mark[KIND] == kind]
        if len(alike) >= _OF_A_KIND:
            row = marks.pop(alike[0])[ROW]
        elif row >= MOST_EXEMPLARS:
            row = marks.pop(0)[ROW]
        elif row >= len(self.looks):
            self._grow(min(max(2 * row, 1), MOST_EXEMPLARS), len(look))
        self.looks[row] = look
        marks.append((inverse, cos, sin, run, kind, row))

    def by_row(self) -> list[Exemplar]:
        """The exemplars in the order of the rows of their looks."""
        return sorted(self.marks, key=itemgetter(ROW))

    def where(self) -> Estimate:
        """The estimate, which every thing in the index has."""
        if self.estimate is None:
            raise ValueError("this thing was never estimated")
        return self.estimate

    def count_label(self, label: str) -> None:
        """Count an observation's label and update the class as `reclassify` does, without comparing
        all classes."""
        count = self.classes.get(label, 0) + 1
        self.classes[label] = count
        most = self.classes[self.class_name]
        if count > most:
            self.class_name = label
        elif count == most > 1:
            both = (label, self.class_name)
            self.class_name = next(name for name in self.classes if name in both)

    def reclassify(self) -> None:
        """Set the class to that of most observations; of several the one seen first."""
        self.class_name = max(self.classes, key=self.classes.__getitem__)

    def absorb(self, other: "FusedThing") -> None:
        """Add all observations, spots and exemplars of another thing."""
        self.count += other.count
        self.sum_x_um += other.sum_x_um
        self.sum_y_um += other.sum_y_um
        self.first_seen = min(self.first_seen, other.first_seen)
        self.last_seen = max(self.last_seen, other.last_seen)
        for class_name, count in other.classes.items():
            self.classes[class_name] = self.classes.get(class_name, 0) + count
        self.spots.add_all(other.spots)
        self.groups |= other.groups
        for inverse, cos, sin, run, _, row in other.marks:
            self.keep(other.looks[row], inverse, cos, sin, run)
        self.reclassify()

    def _grow(self, size: int, dim: int) -> None:
        count = len(self.looks)
        looks = np.zeros((size, dim), np.float32)
        if count:
            looks[:count] = self.looks
        self.looks = looks


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

    def ratio(self, thing: FusedThing, label: str, usual: float) -> float:
        """The logarithm of the label's probability for the thing, over its ``usual`` one."""
        own = (thing.classes.get(label, 0) + _DOUBT * usual) / (thing.count + _DOUBT)
        return log_of(own / usual)

    def usual(self, label: str) -> float:
        """The label's probability among all observations."""
        return (self._counts.get(label, 0) + 1.0) / (self._total + 10.0)

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {"counts": sorted(map(list, self._counts.items()))}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._counts = dict(state["counts"])
        self._total = sum(self._counts.values())
