"""Fit the weights of `projections.relocalize.features` on generated buildings; print them.

Buildings 0 … 9 are fitted on; 10 … 13 are held out and reported beside them. Each is asked with one
to three crops, mapped whole and by its first third only, by its own second session and by another
building's. Plain gradient descent (Newton's), so that nothing but numpy is needed.

    scripts/fit_confidence [--step 2]
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from projections.evaluate.scores import auroc, expected_calibration_error
from projections.relocalize import Camera, ExactIndex, Question
from projections.relocalize.features import WEIGHTS
from projections.relocalize.likelihood import Scene
from projections.relocalize.model import MODEL
from projections.relocalize.pose import locate
from tests.relocalization.buildings import Building, Keyframe
from tests.relocalization.drives import drive
from tests.relocalization.rooms import crops_of, fold

FITTED, HELD_OUT = range(10), range(10, 14)
WITHIN_M = 1.5
RIDGE = 0.1
Row = tuple[tuple[float, ...], bool, bool, int]
"""Features, whether the answer was right, whether the question was known, number of crops."""


def runs_of(seed: int) -> tuple[list[Keyframe], list[Keyframe]]:
    """A building's exploring run, 700 keyframes, and a second session of 400."""
    building = Building(
        seed,
        columns=2 + seed % 3,
        rows=2 + seed // 2 % 2,
        things=50 + 10 * (seed % 5),
        look_alikes=0.3 + 0.225 * (seed % 3),
    )
    return (
        drive(building, f"b{seed}-a", 1000 + seed, 700),
        drive(building, f"b{seed}-b", 2000 + seed, 400),
    )


def ask(mapped: Sequence[Keyframe], asked: Sequence[Keyframe], step: int) -> list[Row]:
    """Features and outcome of every ``step``-th question with one, two and three crops."""
    index = ExactIndex(fold(mapped))
    instances = {i for k in mapped for i in k.instances if i is not None}
    rows: list[Row] = []
    for crops in (1, 2, 3):
        rng = np.random.default_rng(crops)
        usable = [k for k in asked if len(k.instances) >= crops]
        for keyframe in usable[::step]:
            drawn = sorted(rng.choice(len(keyframe.instances), crops, replace=False))
            rows.append(_row(index, instances, keyframe, drawn))
    return rows


def _row(index: ExactIndex, instances: set[str], keyframe: Keyframe, drawn: list[int]) -> Row:
    seen = crops_of(keyframe)
    crops = sorted((seen[i] for i in drawn), key=lambda crop: crop.sort_key)
    known = any(keyframe.instances[i] in instances for i in drawn)
    scene = Scene(index.constants, Camera(), MODEL)
    posterior = locate(Question.of(crops).views, index.search(crops).matches, scene)
    if posterior is None:
        return (0.0,) * (len(WEIGHTS) - 1), False, known, len(crops)
    envelope = keyframe.accepted.envelope
    error = math.hypot(posterior.x - (envelope.map_x or 0), posterior.y - (envelope.map_y or 0))
    return astuple(posterior.features), known and error <= WITHIN_M, known, len(crops)


def fit(x: NDArray[np.float64], y: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Logistic regression with a little ridge, by Newton's method; intercept first."""
    x = np.column_stack((np.ones(len(x)), x))
    weights = np.zeros(x.shape[1])
    penalty = RIDGE * np.eye(x.shape[1])
    penalty[0, 0] = 0.0
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(x @ weights, -40, 40)))
        gradient = x.T @ (p - y) + penalty @ weights
        hessian = (x * (p * (1 - p))[:, None]).T @ x + penalty
        weights = weights - np.linalg.solve(hessian, gradient)
    return weights


def report(name: str, rows: Sequence[Row], weights: NDArray[np.float64]) -> None:
    """One line: how many, calibration error, AUROC of known against unknown."""
    x = np.array([(1.0, *row[0]) for row in rows])
    p = (1 / (1 + np.exp(-np.clip(x @ weights, -40, 40)))).tolist()
    ece = expected_calibration_error(p, [row[1] for row in rows])
    apart = auroc(
        [c for c, row in zip(p, rows, strict=True) if row[2]],
        [c for c, row in zip(p, rows, strict=True) if not row[2]],
    )
    right = sum(row[1] for row in rows) / len(rows)
    print(f"{name}: {len(rows)} questions, {right:.3f} right, ECE {ece:.3f}, AUROC {apart:.3f}")


def main() -> None:
    """Generate, ask, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=int, default=2, help="use every STEP-th question")
    step = parser.parse_args().step
    runs = {seed: runs_of(seed) for seed in (*FITTED, *HELD_OUT)}
    rows: dict[int, list[Row]] = {}
    for seed, (mapped, asked) in runs.items():
        stranger = runs[(seed + 1) % len(runs)][1]
        rows[seed] = []
        for part in (mapped, mapped[: len(mapped) // 3]):
            rows[seed] += ask(part, asked, step) + ask(part, stranger, 2 * step)
        print(f"building {seed}: {len(rows[seed])} questions", file=sys.stderr)
    fitted = [row for seed in FITTED for row in rows[seed]]
    weights = fit(np.array([row[0] for row in fitted]), np.array([row[1] for row in fitted]))
    report("fitted", fitted, weights)
    held_out = [row for seed in HELD_OUT for row in rows[seed]]
    for crops in (1, 2, 3):
        report(f"held out, {crops} crops", [row for row in held_out if row[3] == crops], weights)
    print(f"WEIGHTS = ({', '.join(f'{w:.3f}' for w in weights)})")


if __name__ == "__main__":
    main()
