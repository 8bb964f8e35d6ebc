"""Several runs in one frame: every two are aligned, and one least squares goes over all pairs that
agree.

Two pairs or more that lead from one run to another must agree within their errors; of pairs that do
not, those are kept whose scores have the largest sum. A pair that contradicts the others counts
against the weakest cut through them that would have to be wrong for it to be right, as the next
best transform counts against a transform.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final, NamedTuple

import numpy as np

from eventsrc.base.progress import reported
from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import RunId

from .alignment import LIKELY, SURE, Alignment, Verdict, align, move_text
from .framed_things import FramedThings
from .matching import Floats, Transform, jacobians, least_cut, moved, rotation

_ERRORS, _SLACK_M = 3.0, 0.3
"""A circle of pairs closes within three standard errors and what drift within a run may do."""
_STEPS: Final = 8
_NOWHERE: Final = (0.0, 0.0, 0.0)


class RunPair(NamedTuple):
    """The transform of the run ``other`` into the frame of the run ``one``, by their numbers."""

    one: int
    other: int
    found: Alignment


@dataclass(frozen=True, slots=True)
class PlacedRun:
    """A run in the frame of another, by ``pairs`` pairs of runs; as in `Alignment`."""

    run: RunId
    frame: RunId
    transform: Transform
    se_m: float
    shift_m: float
    pairs: int
    verdict: Verdict

    @property
    def is_one_frame(self) -> bool:
        """Whether it is in that frame already."""
        return self.shift_m <= 2.0 * self.se_m

    def __str__(self) -> str:
        into = f"{visible(self.run)} into the frame of {visible(self.frame)}"
        if self.verdict == "unknown":
            return f"{into}: cannot tell, for pairs of runs contradict each other"
        move = move_text(self.transform, self.se_m, self.verdict, self.is_one_frame)
        by = "" if self.is_one_frame else f": by {counted(self.pairs, 'pair')} of runs"
        return f"{into}: {move}{by}"

    def document(self) -> dict[str, Any]:
        """The run as JSON."""
        x, y, angle = self.transform
        return {
            "run": self.run,
            "to": self.frame,
            "verdict": self.verdict,
            "transform": {"x": x, "y": y, "yaw_rad": angle},
            "se_m": self.se_m,
            "shift_m": self.shift_m,
            "pairs": self.pairs,
        }


class Contradiction(NamedTuple):
    """Two runs whose pair does not agree with the others; ``against`` is the score of these."""

    one: RunId
    other: RunId
    score: float
    against: float

    def __str__(self) -> str:
        return (
            f"{visible(self.one)} and {visible(self.other)} contradict the other pairs: score"
            f" {self.score:.0f} against {self.against:.0f}"
        )


def align_runs(things: Mapping[RunId, FramedThings]) -> tuple[list[PlacedRun], list[Contradiction]]:
    """The runs that have a place in the frame of an earlier one, and the pairs that contradict."""
    runs = list(things)
    pairs = []
    every = list(combinations(range(len(runs)), 2))
    for one, other in reported(every, "aligning pairs of runs", len(every), "pairs"):
        found = align(things[runs[one]], things[runs[other]])
        if found is not None and found.verdict != "unknown":
            pairs.append(RunPair(one, other, found))
    return placed_runs(runs, [things[run].poses for run in runs], pairs)


def placed_runs(
    runs: Sequence[RunId], poses: Sequence[Floats], pairs: Sequence[RunPair]
) -> tuple[list[PlacedRun], list[Contradiction]]:
    """The same by the pairs that were found and the poses (k, 3) of each run."""
    kept = _most_consistent(poses, pairs)
    against = [
        Contradiction(
            runs[pair.one], runs[pair.other], pair.found.score, _weakest_cut(len(runs), kept, pair)
        )
        for pair in pairs
        if pair not in kept
    ]
    root = _components(len(runs), kept)
    in_doubt: dict[int, Verdict] = {}
    for pair, each in zip((p for p in pairs if p not in kept), against, strict=True):
        if each.score > LIKELY.second * each.against:
            in_doubt[root[pair.one]] = "unknown"
        elif each.score > SURE.second * each.against:
            in_doubt.setdefault(root[pair.one], "likely")
    sure = _components(len(runs), [pair for pair in kept if pair.found.verdict == "sure"])
    found = []
    for frame in sorted(set(root)):
        members = [number for number in range(len(runs)) if root[number] == frame]
        if len(members) == 1:
            continue
        own = [pair for pair in kept if root[pair.one] == frame]
        transforms, covariance = _fitted(members, own, _by_tree(len(runs), own))
        for place, number in enumerate(members[1:]):
            transform = transforms[number]
            here = poses[number][:, :2]
            slopes = jacobians(here @ rotation(transform[2]).T)
            block = covariance[3 * place : 3 * place + 3, 3 * place : 3 * place + 3]
            errors = np.einsum("nij,jk,nik->n", slopes, block, slopes)
            verdict: Verdict = "sure" if sure[number] == sure[frame] else "likely"
            doubt = in_doubt.get(frame, verdict)
            found.append(
                PlacedRun(
                    runs[number],
                    runs[frame],
                    transform,
                    math.sqrt(float(errors.mean())),
                    _rms_m(here, transform, _NOWHERE),
                    sum(number in pair[:2] for pair in own),
                    doubt if verdict == "sure" or doubt == "unknown" else verdict,
                )
            )
    return found, against


def _components(count: int, pairs: Sequence[RunPair]) -> list[int]:
    """For each run the first one that it is connected to."""
    return [node.root for node in _by_tree(count, pairs)]


def _most_consistent(poses: Sequence[Floats], pairs: Sequence[RunPair]) -> list[RunPair]:
    """The pairs that agree with the transforms along a tree of pairs: that of the largest scores,
    then without each of its pairs that makes the sum of scores of those that agree larger."""
    left_out: set[int] = set()
    best = _agreeing(poses, pairs, left_out)
    while True:
        tries = [
            (n, _agreeing(poses, pairs, left_out | {n}))
            for n in range(len(pairs))
            if n not in left_out
        ]
        better = max(tries, key=lambda each: (_sum(each[1]), -each[0]), default=None)
        if better is None or _sum(better[1]) <= _sum(best):
            return best
        left_out.add(better[0])
        best = better[1]


def _sum(pairs: Sequence[RunPair]) -> float:
    return math.fsum(pair.found.score for pair in pairs)


def _agreeing(
    poses: Sequence[Floats], pairs: Sequence[RunPair], left_out: Collection[int]
) -> list[RunPair]:
    """The pairs that agree with the tree of the largest scores without some."""
    tree = _by_tree(
        len(poses), [pair for number, pair in enumerate(pairs) if number not in left_out]
    )
    agree = []
    for pair in pairs:
        one, other = tree[pair.one], tree[pair.other]
        if one.root == other.root:
            expected = _composed(_inverse(one.transform), other.transform)
            apart = _rms_m(poses[pair.other][:, :2], expected, pair.found.transform)
            variance = pair.found.se_m**2 + one.variance + other.variance
            if apart <= _ERRORS * math.sqrt(variance) + _SLACK_M:
                agree.append(pair)
    return agree


class _Node(NamedTuple):
    """A run in the frame of the first one that it is connected to."""

    root: int
    transform: Transform
    variance: float


def _by_tree(count: int, pairs: Sequence[RunPair]) -> list[_Node]:
    """Each run by the tree of pairs that has the largest scores."""
    group = list(range(count))
    links: list[list[tuple[int, Transform, float]]] = [[] for _ in range(count)]
    for one, other, found in sorted(pairs, key=lambda pair: -pair.found.score):
        if group[one] != group[other]:
            links[one].append((other, found.transform, found.se_m**2))
            links[other].append((one, _inverse(found.transform), found.se_m**2))
            group = [group[one] if each == group[other] else each for each in group]
    nodes: dict[int, _Node] = {}
    for root in range(count):
        waiting = [] if root in nodes else [(root, _Node(root, _NOWHERE, 0.0))]
        for number, node in waiting:  # which grows
            nodes[number] = node
            waiting += [
                (to, _Node(root, _composed(node.transform, by), node.variance + variance))
                for to, by, variance in links[number]
                if to not in nodes
            ]
    return [nodes[number] for number in range(count)]


def _weakest_cut(count: int, kept: Sequence[RunPair], pair: RunPair) -> float:
    """The least sum of scores of pairs without which two runs would not be connected."""
    ends = [(each.one, each.other) for each in kept]
    return least_cut(count, ends, [each.found.score for each in kept], pair[:2])


def _fitted(
    members: Sequence[int], pairs: Sequence[RunPair], start: Sequence[_Node]
) -> tuple[dict[int, Transform], Floats]:
    """The transforms of the members into the frame of the first, by least squares over all pairs,
    and the covariance of those of the others."""
    places = {number: place for place, number in enumerate(members)}
    at = np.array([start[number].transform for number in members])
    size = 3 * len(members)
    information: Floats = np.eye(size)
    for _ in range(_STEPS):
        information[:], gradient = 1e-9 * np.eye(size), np.zeros(size)
        for one, other, found in pairs:
            i, j = places[one], places[other]
            back, apart = rotation(-at[i, 2]), at[j, :2] - at[i, :2]
            error = np.empty(3)
            error[:2] = np.array(found.transform[:2]) - back @ apart
            error[2] = math.remainder(found.transform[2] - at[j, 2] + at[i, 2], math.tau)
            slopes = np.zeros((3, size))
            slopes[:2, 3 * i : 3 * i + 2], slopes[:2, 3 * j : 3 * j + 2] = -back, back
            slopes[:2, 3 * i + 2] = rotation(-at[i, 2] - math.pi / 2) @ apart
            slopes[2, 3 * i + 2], slopes[2, 3 * j + 2] = -1.0, 1.0
            information += slopes.T @ found.information @ slopes
            gradient += slopes.T @ found.information @ error
        at[1:] += np.linalg.solve(information[3:, 3:], gradient[3:]).reshape(-1, 3)
    transforms = {
        number: (float(x), float(y), math.remainder(float(angle), math.tau))
        for number, (x, y, angle) in zip(members, at, strict=True)
    }
    covariance: Floats = np.asarray(np.linalg.inv(information[3:, 3:]), np.float64)
    return transforms, covariance


def _composed(one: Transform, other: Transform) -> Transform:
    """First ``other``, then ``one``."""
    ((x, y),) = moved(np.array([other[:2]]), one).tolist()
    return x, y, math.remainder(one[2] + other[2], math.tau)


def _inverse(transform: Transform) -> Transform:
    x, y = (-rotation(-transform[2]) @ np.array(transform[:2])).tolist()
    return x, y, -transform[2]


def _rms_m(xy: Floats, one: Transform, other: Transform) -> float:
    """How far apart two transforms bring points, root mean square."""
    apart = moved(xy, one) - moved(xy, other)
    return math.sqrt(float((apart * apart).sum(1).mean()))
