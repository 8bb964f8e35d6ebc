"""What fusion by evidence knows of one Object: its observations' sums, its spots, its exemplars.

Exemplars are looks that are kept to compare new ones with, by side and session: of one run and one
eighth of the directions the newest `_OF_A_KIND`, and `MOST_EXEMPLARS` in all; then the oldest goes.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from projections.deltas import ObjectOrdinal

from .class_heights import Given
from .spots import Estimate, Spots

MOST_EXEMPLARS = 6
_OF_A_KIND = 3
INVERSE, SIDE_COS, SIDE_SIN, RUN, KIND = range(5)
"""Columns of ``marks``: 1 / length of the look, line of sight, run, kind of exemplar."""


@dataclass(slots=True, eq=False)
class Thing:
    """``classes`` counts observations by class, the class seen first being first; ``met`` the
    pictures that show another thing too. ``checked`` is at how many observations the next search
    for a thing to merge with is due."""

    count: int
    sum_x_um: int
    sum_y_um: int
    first_seen: float
    last_seen: float
    class_name: str
    classes: dict[str, int]
    spots: Spots
    looks: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    marks: NDArray[np.float64] = field(default_factory=lambda: np.zeros((MOST_EXEMPLARS, 5)))
    exemplars: int = 0
    cell: tuple[int, int] = (0, 0)
    met: dict[ObjectOrdinal, int] = field(default_factory=dict)
    checked: int = 2
    given: Given | None = None
    estimate: Estimate | None = None
    groups: set[int] = field(default_factory=set)

    def keep(
        self, look: NDArray[np.float32], inverse: float, cos: float, sin: float, run: int
    ) -> None:
        """Make a look an exemplar."""
        kind = run * 8 + _eighth(cos, sin)
        count = self.exemplars
        alike = [i for i, other in enumerate(self.marks[:count, KIND].tolist()) if other == kind]
        if len(alike) >= _OF_A_KIND:
            count = self._drop(alike[0])
        elif count >= MOST_EXEMPLARS:
            count = self._drop(0)
        elif count >= len(self.looks):
            self._grow(min(max(2 * count, 1), MOST_EXEMPLARS), len(look))
        self.looks[count] = look
        self.marks[count] = inverse, cos, sin, run, kind
        self.exemplars = count + 1

    def count_label(self, label: str) -> None:
        """Count an observation's label. As `reclassify`, without a look at all classes."""
        count = self.classes.get(label, 0) + 1
        self.classes[label] = count
        most = self.classes[self.class_name]
        if count > most:
            self.class_name = label
        elif count == most > 1:
            both = (label, self.class_name)
            self.class_name = next(name for name in self.classes if name in both)

    def reclassify(self) -> None:
        """Take the class of most observations, the one seen first where two tie."""
        self.class_name = max(self.classes, key=self.classes.__getitem__)

    def absorb(self, other: "Thing") -> None:
        """Take over all that another thing has."""
        self.count += other.count
        self.sum_x_um += other.sum_x_um
        self.sum_y_um += other.sum_y_um
        self.first_seen = min(self.first_seen, other.first_seen)
        self.last_seen = max(self.last_seen, other.last_seen)
        for class_name, count in other.classes.items():
            self.classes[class_name] = self.classes.get(class_name, 0) + count
        self.spots.take_in(other.spots)
        self.groups |= other.groups
        for look, mark in zip(
            other.looks[: other.exemplars], other.marks[: other.exemplars].tolist(), strict=True
        ):
            self.keep(look, mark[INVERSE], mark[SIDE_COS], mark[SIDE_SIN], int(mark[RUN]))
        self.reclassify()

    def _drop(self, index: int) -> int:
        last = self.exemplars - 1
        self.looks[index:last] = self.looks[index + 1 : last + 1].copy()
        self.marks[index:last] = self.marks[index + 1 : last + 1].copy()
        return last

    def _grow(self, size: int, dim: int) -> None:
        count = self.exemplars
        looks = np.zeros((size, dim), np.float32)
        if count:
            looks[:count] = self.looks
        self.looks = looks


def _eighth(cos: float, sin: float) -> int:
    """Which eighth of the directions, 0 to 7."""
    return (cos > 0.0) * 4 + (sin > 0.0) * 2 + (abs(cos) > abs(sin))
