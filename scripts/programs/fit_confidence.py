"""Fit the weights of re-localisation's two probabilities on generated buildings; print them.

    scripts/fit_confidence [--every 4] [--jobs 2] [--cache DIR]

Robots and buildings of the developing half of ``worlds`` (`bench.truth.worlds`): four of its
buildings are fitted on, the others are held out and reported beside them. Run a makes the map, by
evidence and with its own constants; the later runs ask it with one to three crops and with one to
five views, and so do as many questions from another building. Then the maps are asked their own
questions with the weights found: how far the probabilities are off there is what `mapfold
calibrate` compares a map with.
"""

import argparse
import functools
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.localize.calibrate.localiser import Line, fit_line, logit
from projections.localize.evaluate.own_questions import ask_own_questions
from projections.localize.evaluate.scores import (
    auroc,
    calibration_floor,
    expected_calibration_error,
    instances_of,
)
from projections.localize.evaluate.trials import RIGHT_WITHIN_M
from projections.localize.relocalize import ExactIndex, certainty
from projections.localize.relocalize.constants import MODEL
from projections.localize.relocalize.likelihood import Scene
from projections.localize.relocalize.pose import locate
from projections.map.view import MapView
from scripts.programs.bench.truth.localising import asked, make_map, stranger_of
from scripts.programs.bench.truth.worlds import (
    CACHE,
    WORLDS,
    Case,
    load_generator,
    make_case,
    pairs,
)

HELD_OUT = ("rmf_hotel", "aws_hospital")
RIDGE = 0.3
CROPS = (1, 2, 3)
Floats = NDArray[np.float64]


class Row(NamedTuple):
    """One question: features of both models, whether it was known, whether the pose was right."""

    pair: tuple[str, str]
    kind: str
    known_features: tuple[float, ...]
    features: tuple[float, ...]
    known: bool
    right: bool


class Weights(NamedTuple):
    """Of `known` and `confidence`, intercepts first."""

    known: tuple[float, ...]
    confidence: tuple[float, ...]


def cases(pair: tuple[str, str], cache: Path) -> tuple[Case, Case]:
    """A robot in a building, and in another one."""
    profile, world = pair
    generator = load_generator(WORLDS)
    other = stranger_of(generator, "develop", world)
    own, stranger = (make_case(generator, profile, each, cache=cache) for each in (world, other))
    return own, stranger


def ask(every: int, cache: Path, pair: tuple[str, str]) -> list[Row]:
    """The questions of every kind that have candidates and a pose."""
    case, stranger = cases(pair, cache)
    view = make_map(case, "evidence", ask=False)
    index = ExactIndex(view)
    scene = Scene(index.constants, index.constants.camera, MODEL)
    instances = {i for _, i in instances_of(view, case.truth) if i is not None}
    rows = []
    for kind, (own, others) in asked(case, stranger, every, CROPS).items():
        for question in [*own, *others]:
            matches = index.search(question.crops).matches
            alike = certainty.known_features(question.crops, matches, index.constants)
            posterior = locate(question.asked.views, matches, scene)
            if alike is None or posterior is None:
                continue
            known = any(i in instances for i in question.instances if i is not None)
            off = math.hypot(posterior.x - question.x, posterior.y - question.y)
            found = astuple(posterior.features)
            right = known and off <= RIGHT_WITHIN_M
            rows.append(Row(pair, kind, alike, found, known, right))
    return rows


def ask_itself(
    weights: Weights, cache: Path, pair: tuple[str, str]
) -> list[tuple[float, bool, float, bool]]:
    """Of a map's own questions the logit of `known` and whether it was, and of `confidence`."""
    certainty.KNOWN_WEIGHTS, certainty.CONFIDENCE_WEIGHTS = weights  # type: ignore[misc, assignment]
    view: MapView = make_map(cases(pair, cache)[0], "evidence", ask=False)
    answers = [each for crops in (1, 3) for each in ask_own_questions(view, crops)]
    return [
        (logit(a.answer.known), a.known, logit(a.answer.confidence), a.correct) for a in answers
    ]


def fit(x: Floats, y: NDArray[np.bool_], weight: Floats) -> tuple[float, ...]:
    """Logistic regression with a little ridge, by Newton's method; intercept first."""
    spread_of = x.std(axis=0) + 1e-9
    x = np.column_stack((np.ones(len(x)), x / spread_of))
    weights = np.zeros(x.shape[1])
    penalty = RIDGE * np.eye(x.shape[1])
    penalty[0, 0] = 0.0
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(x @ weights, -40, 40)))
        gradient = x.T @ (weight * (p - y)) + penalty @ weights
        hessian = (x * (weight * p * (1 - p))[:, None]).T @ x + penalty
        weights = weights - np.linalg.solve(hessian, gradient)
    weights[1:] /= spread_of
    return tuple(round(float(each), 3) for each in weights)


def fit_both(rows: Sequence[Row]) -> Weights:
    """Every map counts the same, however many questions it was asked."""
    asked = {pair: sum(row.pair == pair for row in rows) for pair in {row.pair for row in rows}}
    weight = np.array([len(rows) / len(asked) / asked[row.pair] for row in rows])
    known = np.array([row.known for row in rows])
    right = np.array([row.right for row in rows])
    return Weights(
        fit(np.array([row.known_features for row in rows]), known, weight),
        fit(np.array([row.features for row in rows]), right, weight),
    )


def report(name: str, rows: Sequence[Row], weights: Weights) -> None:
    """Means over maps, by kind of question: AUROC, shares wrongly called, calibration errors."""
    for kind in dict.fromkeys(row.kind for row in rows):
        of_maps = []
        for pair in dict.fromkeys(row.pair for row in rows):
            own = [row for row in rows if row.pair == pair and row.kind == kind]
            if not (0 < sum(row.known for row in own) < len(own)):
                continue
            said = [_say(weights.known, row.known_features) for row in own]
            sure = [_say(weights.confidence, row.features) for row in own]
            yes = [p for p, row in zip(said, own, strict=True) if row.known]
            no = [p for p, row in zip(said, own, strict=True) if not row.known]
            best = [[r.known_features[0] for r in own if r.known == k] for k in (True, False)]
            of_maps.append(
                (
                    auroc(yes, no) or 0.0,
                    auroc(*best) or 0.0,
                    sum(p < certainty.UNKNOWN_BELOW for p in yes) / len(yes),
                    sum(p >= certainty.UNKNOWN_BELOW for p in no) / len(no),
                    expected_calibration_error(said, [row.known for row in own]),
                    calibration_floor(said),
                    expected_calibration_error(sure, [row.right for row in own]),
                    calibration_floor(sure),
                )
            )
        if of_maps:
            means = "  ".join(f"{each:.3f}" for each in np.mean(of_maps, axis=0))
            print(f"{name:10} {kind:7} {len(of_maps):3}  {means}")


def _say(weights: Sequence[float], values: Sequence[float]) -> float:
    return certainty.probability(certainty.logit_of(weights, values))


def main() -> None:
    """Ask, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=4, help="use every N-th question")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where generated runs are kept")
    options = parser.parse_args()
    chosen = pairs(load_generator(WORLDS), "develop")
    with ProcessPoolExecutor(options.jobs) as pool:
        asking = functools.partial(ask, options.every, options.cache)
        rows = [row for found in pool.map(asking, chosen) for row in found]
        fitted = [row for row in rows if row.pair[1] not in HELD_OUT]
        held_out = [row for row in rows if row.pair[1] in HELD_OUT]
        weights = fit_both(fitted)
        print("           kind   maps AUROC  cosine k>unk  unk>k  ECE kn floor  ECE co floor")
        report("fitted", fitted, weights)
        report("held out", held_out, weights)
        for robot in dict.fromkeys(pair[0] for pair in chosen):
            others = [row for row in rows if row.pair[0] != robot]
            report(robot, [row for row in rows if row.pair[0] == robot], fit_both(others))
        itself = functools.partial(ask_itself, weights, options.cache)
        of_fitted = [pair for pair in chosen if pair[1] not in HELD_OUT]
        own = [each for found in pool.map(itself, of_fitted) for each in found]
    print(f"KNOWN_WEIGHTS = {weights.known}", file=sys.stdout)
    print(f"WEIGHTS = {weights.confidence}")
    flat = Line(1.0, 0.0)
    known = fit_line([each[0] for each in own], [each[1] for each in own], flat, 1.0)
    sure = fit_line([each[2] for each in own], [each[3] for each in own], flat, 1.0)
    print(f"KNOWN_USUAL = Line({known.scale:.2f}, {known.shift:.2f})")
    print(f"CONFIDENCE_USUAL = Line({sure.scale:.2f}, {sure.shift:.2f})")


if __name__ == "__main__":
    main()
