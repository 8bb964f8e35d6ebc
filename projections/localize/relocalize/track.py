"""Tracking: estimate a robot's pose from successive questions and its odometry.

A particle filter, as in Monte Carlo localisation. Particles move with the odometry, which is taken
to be off by a share of the way and of the turn. A question weighs them with the likelihood that its
posterior over poses gives them: with probability c, the answer's confidence, the robot is near one
of the posterior's poses (Gaussians of 0.4 m and 0.35 rad about them), else it may be anywhere. Two
hypotheses are weighed: the robot is where the particles are, or anywhere (``lost`` is the
probability of that; before each question the robot may have been carried elsewhere). By Bayes' rule
the second says how many particles are replaced by draws from the posterior: few while the particles
explain what is seen, nearly all once they do not and another place does. So a kidnapped robot is
found again after a few questions, and a single wrong answer moves little.

Things that the map does not have (``known`` below 0.5) make it less likely that the robot is where
the particles are, by known / (1 - known), at least an eighth. `known` is that of the session: what
its day costs is learnt from its questions (`certainty.QuestionSession`).

Questions from places near each other share their errors, and a look-alike deceives several in a
row: a likelihood is taken to a power that is the smaller, the less the robot has moved since the
last question, and 1 after 3 m or most of a turn.

The filter is a pure function of the session's name and its questions: no clock, and the random
numbers follow from the name and the number of the question. Floors lie side by side, as in
`projections.localize.relocalize.layout`.
"""

import hashlib
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .camera import Floats
from .certainty import Looks, QuestionSession
from .layout import STEP_M, Hypotheses
from .question import Movement, Question
from .ranking import PoseHypothesis

PARTICLES: Final = 800
_FRESH: Final = 200
"""Particles drawn from the posterior, before the resampling decides how many of them stay."""
_MOST_POSES: Final = 100
"""The likeliest poses of a posterior that are used."""
_CARRIED: Final = 0.01
"""Probability that the robot was carried elsewhere between two questions."""
_LEAST_LOST: Final = 0.005
"""The least `lost`: look-alikes deceive several questions in a row, for which the likelihoods do
not account."""
_NEUTRAL: Final = 0.5
"""`known` of a question without evidence for it, as one of classes alone."""
_LEAST_DOUBT: Final = 0.125
"""The least likelihood ratio, for the robot being where the particles are, of a question whose
things are not in the map."""
_ANYWHERE: Final = 1.0 / (1_000.0 * 2.0 * math.pi)
"""Density of a robot's pose that may be anywhere: 1,000 m², any heading."""
_SIGMA_M: Final = 0.4
_SIGMA_RAD: Final = 0.35
_HEIGHT: Final = 1.0 / ((2.0 * math.pi) ** 1.5 * _SIGMA_M**2 * _SIGMA_RAD)
"""Greatest density of a Gaussian about a pose."""
_JITTER_M: Final = 0.15
_JITTER_RAD: Final = 0.1
_LEAST_SURE, _MOST_SURE = 0.02, 0.95
_SLIP_M, _SLIP_PER_M, _SLIP_M_PER_RAD = 0.01, 0.1, 0.02
_SLIP_RAD, _SLIP_RAD_PER_M, _SLIP_PER_RAD = 0.01, 0.04, 0.1
_MOST_SLIP_M, _MOST_SLIP_RAD = 5.0, math.pi
_INDEPENDENT_M: Final = 3.0
_INDEPENDENT_RAD: Final = 5.0
_LEAST_COUNT: Final = 0.1
_LEAST_COUNT_OF_KNOWN: Final = 0.25
"""The least power for `known`: whether a thing is in the map hardly depends on where it is seen
from."""
_WITHIN_M: Final = 1.5
_AROUND_M: Final = 1.0
_TRIED: Final = 80
_MIN_YAW_AGREEMENT: Final = 0.8


@dataclass(frozen=True, slots=True)
class Tracked:
    """The estimate after a number of ``questions``; no pose as long as none of them had one.

    ``confidence`` is the probability that the pose is right within 1.5 m. The pose's ``spread_m``
    is the root mean square distance of the particles from it. ``known`` is the probability that the
    map has something that the last question shows, by those before it; ``known_spread`` its
    standard deviation, None without embeddings.
    """

    pose: PoseHypothesis | None
    confidence: float
    questions: int
    known: float
    known_spread: float | None

    def document(self) -> dict[str, Any]:
        """As JSON."""
        pose = None if self.pose is None else self.pose.document()
        return {
            "pose": pose,
            "confidence": self.confidence,
            "known": self.known,
            "known_spread": self.known_spread,
            "questions": self.questions,
        }


class Track:
    """The particles of one session. ``name`` decides the random numbers.

    ``particles`` (n, 3) are x, y in metres and yaw in radians, all of the same weight; none before
    the first question that is answered with a pose. ``lost`` is the probability that the robot is
    not among them.
    """

    def __init__(self, name: str) -> None:
        self._seed = int.from_bytes(
            hashlib.sha256(name.encode("utf-8", "surrogatepass")).digest()[:16], "big"
        )
        self._questions = 0
        self._floors: list[str | None] = []
        self._moved = math.inf
        self._session = QuestionSession()
        self.particles: Floats = np.zeros((0, 3))
        self.lost = 1.0

    def step(
        self,
        moved: Movement,
        hypotheses: Hypotheses | None,
        confidence: float,
        known: float = _NEUTRAL,
        looks: Looks | None = None,
    ) -> Tracked:
        """Take in one question: the robot's movement since the last one, and the answer's poses.

        ``known`` is the probability that the map has the things shown, of the question alone; 0.5
        is no evidence. With ``looks`` it is computed again, by the session's questions.
        """
        self._questions += 1
        spread = None
        if looks is not None:
            known, spread = self._session.known(looks)
            self._session.add(looks)
        random = np.random.Generator(np.random.PCG64([self._seed, self._questions]))
        if len(self.particles):
            self._move(moved, random)
        power = min(max(self._moved, _LEAST_COUNT), 1.0)
        self.lost += (1.0 - self.lost) * _CARRIED
        among = (1.0 - self.lost) * _known_ratio(known) ** max(power, _LEAST_COUNT_OF_KNOWN)
        if hypotheses is not None:
            sure = min(max(confidence, _LEAST_SURE), _MOST_SURE)
            self._weigh(hypotheses, sure, among, power, random)
        else:
            self.lost /= self.lost + among
        if not len(self.particles):
            return Tracked(None, 0.0, self._questions, known, spread)
        self._moved = 0.0
        pose, confidence = self._estimate()
        return Tracked(pose, confidence, self._questions, known, spread)

    def _move(self, moved: Movement, random: np.random.Generator) -> None:
        """Move the particles, each with its own random slip."""
        dx, dy, dyaw = moved
        way, turn = math.hypot(dx, dy), abs(dyaw)
        self._moved += way / _INDEPENDENT_M + turn / _INDEPENDENT_RAD
        slip_m = min(_SLIP_M + _SLIP_PER_M * way + _SLIP_M_PER_RAD * turn, _MOST_SLIP_M)
        slip_rad = min(_SLIP_RAD + _SLIP_RAD_PER_M * way + _SLIP_PER_RAD * turn, _MOST_SLIP_RAD)
        drawn = random.standard_normal((len(self.particles), 3)) * (slip_m, slip_m, slip_rad)
        # The heading's slip is half before and half after the way.
        heading = self.particles[:, 2] + drawn[:, 2] / 2.0
        cos, sin = np.cos(heading), np.sin(heading)
        ahead, left = dx + drawn[:, 0], dy + drawn[:, 1]
        self.particles = np.stack(
            (
                self.particles[:, 0] + cos * ahead - sin * left,
                self.particles[:, 1] + sin * ahead + cos * left,
                _wrapped(heading + drawn[:, 2] / 2.0 + math.remainder(dyaw, 2.0 * math.pi)),
            ),
            axis=1,
        )

    def _weigh(
        self,
        hypotheses: Hypotheses,
        sure: float,
        among: float,
        power: float,
        random: np.random.Generator,
    ) -> None:
        """Weigh the particles, which weigh ``among`` together, and some fresh ones, and draw
        ``PARTICLES`` of them again."""
        poses, shares = hypotheses.poses[:_MOST_POSES].copy(), hypotheses.weights[:_MOST_POSES]
        poses[:, 0] += [STEP_M * self._number(name) for name in hypotheses.floors[:_MOST_POSES]]
        shares = shares / shares.sum()
        first = not len(self.particles)
        fresh = poses[_resampled(shares, PARTICLES if first else _FRESH, random)]
        fresh = fresh + random.standard_normal(fresh.shape) * (_JITTER_M, _JITTER_M, _JITTER_RAD)
        fresh[:, 2] = _wrapped(fresh[:, 2])
        lost = self.lost
        ratios = _likelihood(self.particles, poses, shares, sure) / _ANYWHERE
        stayed = np.power(ratios, power) * (among / max(len(self.particles), 1))
        # The likelihood's integral over all poses: near those of the posterior, and elsewhere; of a
        # share that is new.
        found = lost * sure * power
        elsewhere = lost - found
        weights = np.concatenate((stayed, np.full(len(fresh), found / len(fresh))))
        total = float(weights.sum())
        self.lost = max(elsewhere / (elsewhere + total), _LEAST_LOST)
        every = np.concatenate((self.particles, fresh))
        self.particles = every[_resampled(weights / total, PARTICLES, random)]

    def _number(self, floor: str | None) -> int:
        if floor not in self._floors:
            self._floors.append(floor)
        return self._floors.index(floor)

    def _estimate(self) -> tuple[PoseHypothesis, float]:
        """The pose with most particles within 1 m, moved to their mean, and its confidence."""
        at = self.particles[:: max(1, len(self.particles) // _TRIED)]
        dx = at[:, 0][:, None] - self.particles[None, :, 0]
        dy = at[:, 1][:, None] - self.particles[None, :, 1]
        best = int(np.argmin(np.minimum(np.hypot(dx, dy), 3.0 * _AROUND_M).sum(1)))
        near = self.particles[np.hypot(dx[best], dy[best]) < _AROUND_M]
        x, y = float(near[:, 0].mean()), float(near[:, 1].mean())
        away = np.hypot(self.particles[:, 0] - x, self.particles[:, 1] - y)
        floor = min(max(round(x / STEP_M), 0), len(self._floors) - 1)
        here = away[away < STEP_M / 2]
        cos, sin = float(np.cos(near[:, 2]).mean()), float(np.sin(near[:, 2]).mean())
        agree = math.hypot(cos, sin) >= _MIN_YAW_AGREEMENT
        pose = PoseHypothesis(
            x - floor * STEP_M,
            y,
            math.atan2(sin, cos) if agree else None,
            float(np.sqrt(np.mean(here * here))),
            self._floors[floor],
        )
        confidence = (1.0 - self.lost) * float((away < _WITHIN_M).mean())
        return pose, confidence


def _known_ratio(known: float) -> float:
    """The ratio of the probabilities of seeing such things where the particles are and elsewhere.

    Things that the map has are seen all over the map, so they are no evidence for one spot in it.
    """
    return 1.0 if known >= _NEUTRAL else max(known / (1.0 - known), _LEAST_DOUBT)


def movement_of(first: Movement, question: Question) -> Movement:
    """The movement up to a question's last view, with ``first`` as the movement up to its first
    view."""
    x, y, yaw = first
    for view in question.views[1:]:
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y = x + cos * view.dx - sin * view.dy, y + sin * view.dx + cos * view.dy
        yaw = math.remainder(yaw + view.dyaw, 2.0 * math.pi)
    return x, y, yaw


def _likelihood(particles: Floats, poses: Floats, shares: Floats, sure: float) -> Floats:
    """The density of the observation, up to a factor: near the poses with probability ``sure``."""
    dx = particles[:, 0][:, None] - poses[None, :, 0]
    dy = particles[:, 1][:, None] - poses[None, :, 1]
    turned = _wrapped(particles[:, 2][:, None] - poses[None, :, 2])
    square = (dx * dx + dy * dy) / _SIGMA_M**2 + turned * turned / _SIGMA_RAD**2
    near: Floats = (np.exp(-0.5 * square) * shares[None]).sum(1) * _HEIGHT
    return sure * near + (1.0 - sure) * _ANYWHERE


def _resampled(weights: Floats, count: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Systematic resampling: ``count`` indices, each in proportion to its weight, give or take
    one."""
    edges = np.cumsum(weights)
    places = (np.arange(count) + random.random()) / count * edges[-1]
    found: NDArray[np.intp] = np.searchsorted(edges, places, side="right")
    return np.minimum(found, len(weights) - 1)


def _wrapped(angle: Floats) -> Floats:
    wrapped: Floats = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    return wrapped
