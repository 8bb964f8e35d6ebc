"""Deltas as fusion by evidence gives them, made by hand, and the rows that they must give.

`SyntheticDeltas` makes events whose deltas keep to the order and the promises of
`projections.fold.deltas`, also of kinds that a real fold gives rarely: merges, missing and
relocated Objects. `expected_rows` computes from all deltas at once what the tables must hold; it
shares nothing with the view or the sinks but the label numbering that docs/projections.md promises.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, getcontext
from typing import Any

import numpy as np
from hypothesis import strategies as st

from projections.fold import deltas as d
from projections.fold.exact import Q40, quantise
from tests.support.rows import gid

_CLASSES = ("cup", "x'}) DETACH DELETE r //", "☕", "chair")
getcontext().prec = 60


@dataclass(frozen=True)
class Step:
    """One event: which Objects it sees and what else happens. Numbers choose among those there."""

    sees: tuple[int, ...] = ()
    place: int | None = None
    merge: tuple[int, int] | None = None
    relocate: int | None = None
    classify: int | None = None
    estimate: int | None = None
    miss: tuple[int, bool] | None = None
    move: int | None = None


_PICK = st.integers(0, 9)
STEPS = st.lists(
    st.builds(
        Step,
        sees=st.lists(_PICK, max_size=3).map(tuple),
        place=st.none() | st.integers(0, 2),
        merge=st.none() | st.tuples(_PICK, _PICK),
        relocate=st.none() | _PICK,
        classify=st.none() | _PICK,
        estimate=st.none() | _PICK,
        miss=st.none() | st.tuples(_PICK, st.booleans()),
        move=st.none() | _PICK,
    ),
    max_size=25,
)


def random_steps(seed: int, count: int) -> list[Step]:
    """Steps where no test shrinks them."""
    rng = np.random.default_rng(seed)

    def maybe(share: float) -> int | None:
        return int(rng.integers(1000)) if rng.random() < share else None

    return [
        Step(
            tuple(int(n) for n in rng.integers(1000, size=rng.integers(4))),
            maybe(0.6),
            (int(rng.integers(1000)), int(rng.integers(1000))) if rng.random() < 0.25 else None,
            maybe(0.2),
            maybe(0.2),
            maybe(0.3),
            (int(rng.integers(1000)), bool(rng.random() < 0.6)) if rng.random() < 0.3 else None,
            maybe(0.3),
        )
        for _ in range(count)
    ]


def is_bare(observation: int) -> bool:
    """Whether an observation has no embedding."""
    return observation % 5 == 3


@dataclass
class _Sums:
    count: int = 0
    x: int = 0
    y: int = 0
    first: float = 0.0
    last: float = 0.0

    def add(self, other: "_Sums") -> None:
        self.first = min(self.first, other.first) if self.count else other.first
        self.last = max(self.last, other.last) if self.count else other.last
        self.count, self.x, self.y = self.count + other.count, self.x + other.x, self.y + other.y


@dataclass
class SyntheticDeltas:
    """Events in their order; `add` adds one."""

    events: list[list[d.Delta]] = field(default_factory=list)
    _live: dict[int, _Sums] = field(default_factory=dict)
    _places: dict[int, list[int]] = field(default_factory=dict)  # choice → ordinal, count, x, y
    _found: int = 0
    _observations: int = 0

    @classmethod
    def of(cls, steps: Iterable[Step]) -> "SyntheticDeltas":
        """All steps."""
        made = cls()
        for step in steps:
            made.add(step)
        return made

    def add(self, step: Step) -> None:
        """Add the event of a step."""
        n = len(self.events)
        x, y, time = n * 130_000 - 700_000, n * n * 1_000, 100.0 + 0.5 * n
        run = n // 10
        deltas: list[d.Delta] = []
        if n % 10 == 0:
            deltas.append(d.RunSeen(n, run, f"run-{run}", time))
        pose = d.Pose(x, y, 0.1 * n)
        deltas.append(d.KeyframeAdded(n, n, run, f"run-{run}", n % 10, time, pose))
        seen = self._observe(n, run, step.sees, deltas)
        if step.place is not None:
            self._be_in(n, step.place % 3, x, y, deltas)
        for observation, ordinal in seen:
            if ordinal not in self._live:
                self._live[ordinal] = _Sums()
                class_name = _CLASSES[observation % len(_CLASSES)]
                found = d.ObjectFound(n, ordinal, f"obj-{ordinal}", class_name, observation)
                deltas.append(found)
            sums = self._live[ordinal]
            sums.add(_Sums(1, x, y, time, time))
            values = sums.count, sums.x, sums.y, sums.first, sums.last
            similarity = None if is_bare(observation) else Q40 - observation
            deltas.append(d.ObjectSeen(n, ordinal, observation, similarity, *values))
        changed = {ordinal for _, ordinal in seen}
        changed |= self._merge(n, step.merge, deltas)
        if (ordinal := self._pick(step.relocate)) is not None:
            to = (7 * n, -9 * n, x, y)
            deltas.append(d.ObjectRelocated(n, ordinal, self._observations - 1, *to))
        if (ordinal := self._pick(step.classify)) is not None:
            deltas.append(d.ObjectClassified(n, ordinal, _CLASSES[n % len(_CLASSES)]))
        if (ordinal := self._pick(step.estimate)) is not None:
            changed.add(ordinal)
        for ordinal in sorted(changed & self._live.keys()):
            variances = 90_000_000 + n, (-1) ** n * 3_000_001, 10_000_000 * (1 + n)
            deltas.append(d.ObjectEstimated(n, ordinal, x + ordinal, y - n, *variances, 1 + n % 4))
        if step.miss is not None and (ordinal := self._pick(step.miss[0])) is not None:
            deltas.append(d.ObjectMissing(n, ordinal, run, n % 7, step.miss[1]))
        if (ordinal := self._pick(step.move)) is not None:
            places = [None, *(place[0] for place in self._places.values())]
            deltas.append(d.ObjectMoved(n, ordinal, places[n % len(places)]))
        self.events.append(deltas)

    def _pick(self, number: int | None) -> int | None:
        live = sorted(self._live)
        return None if number is None or not live else live[number % len(live)]

    def _observe(
        self, n: int, run: int, picks: Sequence[int], deltas: list[d.Delta]
    ) -> list[tuple[int, int]]:
        """Observations with the Object that each sees: one that is there, or a new one."""
        seen: list[tuple[int, int]] = []
        for pick in picks:
            live = [o for o in sorted(self._live) if o not in {other for _, other in seen}]
            choice = pick % (len(live) + 1)
            if choice == len(live):
                ordinal, self._found = self._found, self._found + 1
            else:
                ordinal = live[choice]
            observation, self._observations = self._observations, self._observations + 1
            bare = is_bare(observation)
            vector = quantise(np.array([1.0, observation, pick], dtype=np.float32))
            deltas.append(
                d.ObservationAdded(
                    n, observation, n, run_id=f"run-{run}", keyframe_id=n % 10,
                    det_id=f"det-{observation}", class_name=_CLASSES[observation % len(_CLASSES)],
                    confidence=0.5, bbox=(1.0, 2.0, 3.0, 4.5),
                    embedding_model=None if bare else "m", embedding=None if bare else vector,
                    foreign_space=False,
                )
            )  # fmt: skip
            seen.append((observation, ordinal))
        return seen

    def _be_in(self, n: int, choice: int, x: int, y: int, deltas: list[d.Delta]) -> None:
        if choice not in self._places:
            self._places[choice] = [len(self._places), 0, 0, 0]
            deltas.append(d.PlaceFormed(n, self._places[choice][0], f"place-{choice}", n))
        place = self._places[choice]
        place[1:] = place[1] + 1, place[2] + x, place[3] + y
        deltas.append(d.KeyframePlaced(n, n, place[0]))
        deltas.append(d.PlaceChanged(n, *place))

    def _merge(self, n: int, picks: tuple[int, int] | None, deltas: list[d.Delta]) -> set[int]:
        if picks is None:
            return set()
        first, second = (self._pick(pick) for pick in picks)
        if first is None or second is None or first == second:
            return set()
        survivor, absorbed = min(first, second), max(first, second)
        sums = self._live[survivor]
        sums.add(self._live.pop(absorbed))
        values = sums.count, sums.x, sums.y, sums.first, sums.last
        evidence = d.MergeEvidence(1_500, -200, 130_000, 0, 4)
        deltas.append(d.ObjectsMerged(n, survivor, absorbed, *values, evidence))
        return {survivor}


def expected_rows(events: Iterable[Sequence[d.Delta]]) -> dict[str, list[tuple[Any, ...]]]:
    """The rows of Object, OBSERVES and LOCATED_IN after these events, by id, properties parsed."""
    deltas = [delta for event in events for delta in event]
    into = {m.absorbed: m.survivor for m in deltas if isinstance(m, d.ObjectsMerged)}

    def now(ordinal: int) -> int:
        while ordinal in into:
            ordinal = into[ordinal]
        return ordinal

    objects, located = [], []
    for found in (f for f in deltas if isinstance(f, d.ObjectFound) and f.object not in into):
        about = [delta for delta in deltas if getattr(delta, "object", None) == found.object]
        members = [
            seen.observation
            for seen in deltas
            if isinstance(seen, d.ObjectSeen) and now(seen.object) == found.object
        ]
        properties = _properties(found, about, deltas)
        moved = [
            each
            for each in deltas
            if isinstance(each, d.ObjectRelocated) and now(each.object) == found.object
        ]
        if moved:
            last = max(moved, key=lambda each: (each.offset, each.observation))
            properties["moved_from_x"] = last.from_x_um / 1e6
            properties["moved_from_y"] = last.from_y_um / 1e6
            properties["moved_at"] = last.offset
        properties["confirmed"] = _is_confirmed(found, members, deltas)
        objects.append((gid("Object", found.object + 1), properties))
        moves = [m.place for m in about if isinstance(m, d.ObjectMoved)]
        if moves and moves[-1] is not None:
            ends = gid("Object", found.object + 1), gid("Place", moves[-1] + 1)
            located.append((gid("LOCATED_IN", found.object + 1), *ends, {}))
    observes = [
        (
            gid("OBSERVES", seen.observation + 1),
            gid("Observation", seen.observation + 1),
            gid("Object", now(seen.object) + 1),
            {} if seen.similarity_q40 is None else {"similarity": seen.similarity_q40 / Q40},
        )
        for seen in deltas
        if isinstance(seen, d.ObjectSeen)
    ]
    rows = {"Object": objects, "OBSERVES": observes, "LOCATED_IN": located}
    return {label: sorted(found, key=lambda row: int(row[0])) for label, found in rows.items()}


def _properties(
    found: d.ObjectFound, about: Sequence[d.Delta], deltas: Sequence[d.Delta]
) -> dict[str, Any]:
    class_name, missing, properties = found.class_name, False, {}
    missing_in: dict[str, Any] = {}
    runs = {each.run: each.run_id for each in deltas if isinstance(each, d.RunSeen)}
    for delta in about:
        match delta:
            case d.ObjectClassified():
                class_name = delta.class_name
            case d.ObjectMissing():
                missing = delta.missing
                missing_in = {"missing_in": runs[delta.run]} if missing else {}
            case d.ObjectRelocated():
                missing, missing_in = False, {}
            case d.ObjectEstimated():
                properties = {
                    "est_x": delta.x_um / 1e6,
                    "est_y": delta.y_um / 1e6,
                    "est_sigma_m": _largest(delta),
                    "est_xx": delta.var_xx_um2 / 1e12,
                    "est_xy": delta.var_xy_um2 / 1e12,
                    "est_yy": delta.var_yy_um2 / 1e12,
                    "est_spots": delta.spots,
                }
            case _:
                pass
    last = [
        delta
        for delta in deltas
        if (isinstance(delta, d.ObjectSeen) and delta.object == found.object)
        or (isinstance(delta, d.ObjectsMerged) and delta.survivor == found.object)
    ][-1]
    return {
        "object_id": found.object_id,
        "class_name": class_name,
        "mean_x": last.sum_x_um / (last.obs_count * 1_000_000),
        "mean_y": last.sum_y_um / (last.obs_count * 1_000_000),
        "obs_count": last.obs_count,
        "first_seen": last.first_seen,
        "last_seen": last.last_seen,
        "missing": missing,
        **missing_in,
        **properties,
    }


def _is_confirmed(found: d.ObjectFound, members: Sequence[int], deltas: Sequence[d.Delta]) -> bool:
    added = {o.observation: o for o in deltas if isinstance(o, d.ObservationAdded)}
    keyframes = {k.keyframe: k for k in deltas if isinstance(k, d.KeyframeAdded)}
    first = keyframes[added[found.observation].keyframe]
    return any(
        added[member].measured
        or now.run != first.run
        or abs(now.timestamp - first.timestamp) > 60.0
        or _far_um2(first.pose, now.pose) >= 350_000**2
        for member in members
        for now in (keyframes[added[member].keyframe],)
    )


def _far_um2(a: d.Pose | None, b: d.Pose | None) -> int:
    return 0 if a is None or b is None else (a.x_um - b.x_um) ** 2 + (a.y_um - b.y_um) ** 2


def _largest(at: d.ObjectEstimated) -> float:
    """The larger standard deviation in metres, worked out to sixty digits."""
    xx, xy, yy = (Decimal(v) for v in (at.var_xx_um2, at.var_xy_um2, at.var_yy_um2))
    larger = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy**2).sqrt()
    return float(larger.sqrt() / 1_000_000)


def without_sigma(
    rows: Sequence[tuple[Any, ...]],
) -> tuple[list[tuple[Any, ...]], dict[str, float]]:
    """Rows of Object without ``est_sigma_m``, and that by id: it is rounded three times, so it is
    compared with a tolerance."""
    bare = [(row[0], {k: v for k, v in row[1].items() if k != "est_sigma_m"}) for row in rows]
    return bare, {row[0]: row[1]["est_sigma_m"] for row in rows if "est_sigma_m" in row[1]}
