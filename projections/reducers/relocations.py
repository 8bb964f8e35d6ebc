"""Relocations: which new Object is one that stood elsewhere in an earlier run.

A *newcomer* is an Object with `_LEAST_NEW` observations or more. Whatever another run found before
it, of the same class, with `_LEAST_OLD` observations and at least a metre away, may be the same
thing, unless it was surely seen in the newcomer's run (`presence`). The evidence is the
log-likelihood ratio of their looks, which must be `_LEAST_LOOK`, less `_ODDS_WEIGHT` of the
logarithm of the older one's odds to be still where it was. The best candidate is the newcomer if
its evidence is `_ENOUGH`; of equal ones the latest.

A newcomer is compared when its observations have doubled, and with an Object whose misses have
doubled. Of a class the latest `_MOST` Objects are kept, and of newcomers, so the cost of a keyframe
is bounded.
"""

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from projections.deltas import (
    Delta,
    ObjectClassified,
    ObjectFound,
    ObjectOrdinal,
    ObjectSeen,
    ObjectsMerged,
    ObservationOrdinal,
)
from projections.exact_functions import log
from projections.reducers import State

from .presence import Presence

_LEAST_NEW, _LEAST_OLD = 4, 2
_APART_M2 = 1.0
_ONE_FLOOR_M2 = 5e7 * 5e7
"""Farther apart are only Objects on two floors, which are laid out beside each other."""
_LEAST_LOOK, _ODDS_WEIGHT = 1.5, 0.3
_ENOUGH = 2.25
_MOST = 128


class Comparing(Protocol):
    """What is asked of the reducer of Objects."""

    def class_of(self, ordinal: ObjectOrdinal) -> str:
        """The class of most of an Object's observations."""

    def observations_of(self, ordinal: ObjectOrdinal) -> int:
        """How many observations an Object has."""

    def compare(self, one: ObjectOrdinal, other: ObjectOrdinal) -> float | None:
        """The log-likelihood ratio of two Objects' looks; None where they are kept apart."""


class Moved(NamedTuple):
    """The Object ``old`` stands where ``new`` was found, by ``observation``; ``look`` is the
    log-likelihood ratio of their looks."""

    old: ObjectOrdinal
    new: ObjectOrdinal
    observation: ObservationOrdinal
    look: float


class _Candidate(NamedTuple):
    evidence: float
    look: float
    old: ObjectOrdinal


class _Newcomer(NamedTuple):
    founded_by: ObservationOrdinal
    due_at: int  # observations at the next comparison


class Relocations:
    """The reducer."""

    def __init__(self, presence: Presence, objects: Comparing) -> None:
        self._presence = presence
        self._objects = objects
        self._newcomers: dict[ObjectOrdinal, _Newcomer] = {}
        self._class_of: dict[ObjectOrdinal, str] = {}
        self._by_class: dict[str, dict[ObjectOrdinal, None]] = {}

    def fold(self, fused: Iterable[Delta]) -> list[Moved]:
        """The Objects that turn out to stand elsewhere; the caller makes the two of each one.

        ``fused`` are the deltas of fusion; `Presence` must have taken them in.
        """
        pairs: list[Moved] = []
        due = self._apply(fused)
        for ordinal in self._presence.missed:
            misses = self._presence.attendance[ordinal].run_misses
            if misses & (misses - 1) == 0:
                due += self._newcomers_like(ordinal)
        for newcomer in dict.fromkeys(due):
            best = self._best(newcomer)
            if best is not None:
                first = self._newcomers[newcomer].founded_by
                pairs.append(Moved(best.old, newcomer, first, best.look))
                self._forget(newcomer)
                self._newcomers.pop(best.old, None)
        return pairs

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {
            "newcomers": [[ordinal, *newcomer] for ordinal, newcomer in self._newcomers.items()],
            "classes": [[name, list(own)] for name, own in sorted(self._by_class.items())],
        }

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        for ordinal, first, due_at in state["newcomers"]:
            self._newcomers[ordinal] = _Newcomer(first, due_at)
        for name, ordinals in state["classes"]:
            for ordinal in ordinals:
                self._classify(ordinal, name)

    def _apply(self, fused: Iterable[Delta]) -> list[ObjectOrdinal]:
        """Apply the deltas; the newcomers whose comparison is due."""
        due: list[ObjectOrdinal] = []
        for delta in fused:
            if type(delta) is ObjectFound:
                self._classify(delta.object, delta.class_name)
                self._newcomers[delta.object] = _Newcomer(delta.observation, _LEAST_NEW)
                if len(self._newcomers) > _MOST:
                    del self._newcomers[next(iter(self._newcomers))]
            elif type(delta) is ObjectClassified:
                self._classify(delta.object, delta.class_name)
            elif type(delta) is ObjectSeen:
                newcomer = self._newcomers.get(delta.object)
                if newcomer is not None and delta.obs_count >= newcomer.due_at:
                    due_at = 2 * delta.obs_count
                    self._newcomers[delta.object] = newcomer._replace(due_at=due_at)
                    due.append(delta.object)
            elif type(delta) is ObjectsMerged:
                self._forget(delta.absorbed)
        return [ordinal for ordinal in due if ordinal in self._newcomers]

    def _newcomers_like(self, old: ObjectOrdinal) -> list[ObjectOrdinal]:
        """The newcomers for which an Object is a candidate."""
        own = self._by_class.get(self._objects.class_of(old), {})
        return [
            ordinal
            for ordinal in own
            if ordinal in self._newcomers
            and self._objects.observations_of(ordinal) >= _LEAST_NEW
            and self._could_be(old, ordinal)
        ]

    def _best(self, newcomer: ObjectOrdinal) -> _Candidate | None:
        """The Object that the newcomer is, if it is one."""
        candidates: list[_Candidate] = []
        for old in self._by_class.get(self._objects.class_of(newcomer), {}):
            if self._could_be(old, newcomer):
                look = self._objects.compare(old, newcomer)
                if look is not None:
                    odds = min(self._presence.attendance[old].odds, 1.0)
                    candidates.append(_Candidate(look - _ODDS_WEIGHT * log(odds), look, old))
        best = max(candidates, default=None)
        is_enough = best is not None and best.evidence >= _ENOUGH and best.look >= _LEAST_LOOK
        return best if is_enough else None

    def _could_be(self, old: ObjectOrdinal, newcomer: ObjectOrdinal) -> bool:
        """Whether they can be one thing, whatever they look like."""
        before, now = self._presence.attendance[old], self._presence.attendance[newcomer]
        dx, dy = now.x - before.x, now.y - before.y
        return (
            old < newcomer
            and now.home not in (before.home, before.confirmed)
            and before.odds <= 1.0
            and _APART_M2 <= dx * dx + dy * dy <= _ONE_FLOOR_M2
            and self._objects.observations_of(old) >= _LEAST_OLD
        )

    def _classify(self, ordinal: ObjectOrdinal, class_name: str) -> None:
        """Enter an Object as the latest of its class."""
        self._drop_class(ordinal)
        self._class_of[ordinal] = class_name
        own = self._by_class.setdefault(class_name, {})
        own[ordinal] = None
        if len(own) > _MOST:
            self._drop_class(next(iter(own)))

    def _drop_class(self, ordinal: ObjectOrdinal) -> None:
        class_name = self._class_of.pop(ordinal, None)
        if class_name is not None:
            own = self._by_class[class_name]
            del own[ordinal]
            if not own:
                del self._by_class[class_name]

    def _forget(self, ordinal: ObjectOrdinal) -> None:
        self._drop_class(ordinal)
        self._newcomers.pop(ordinal, None)
