"""Whether runs in frames of their own find each other, and runs of other buildings do not: the
table of ``scripts/bench_truth --align``."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from eventsrc.base.text import table
from eventsrc.envelope.ingest import Accepted
from projections.fold.settings import Settings
from projections.localize.align.alignment import align
from projections.localize.align.framed_things import FramedThings, things_of_map
from projections.localize.align.matching import moved
from projections.map.view import MapView

from .folding import fold_into
from .worlds import Case

Frame = tuple[float, float, float]
_FAR_M, _TURNED_DEG = 1.0, 10.0
_REACH_M = 20.0


@dataclass(frozen=True, slots=True)
class AlignRow:
    """A run whose frame was moved at random, brought back into that of run a: the error over its
    keyframes and of the angle. Of another building, errors are None."""

    name: str
    verdict: str
    common: int
    score: float
    second: float
    se_m: float
    error_m: float | None = None
    error_deg: float | None = None

    @property
    def is_right(self) -> bool:
        """Whether the transform is near the true one."""
        if self.error_m is None or self.error_deg is None:
            return False
        return self.error_m < _FAR_M and self.error_deg < _TURNED_DEG


def align_rows(cases: Sequence[Case], seed: int) -> list[AlignRow]:
    """Each later run of a case against its run a, and against run a of the other cases of the same
    robot."""
    chance = np.random.default_rng(seed)
    frames: dict[str, FramedThings] = {}
    runs: list[tuple[str, str, Frame, FramedThings]] = []
    for case in cases:
        for run in dict.fromkeys(event.envelope.run_id for event in case.events):
            events = [event for event in case.events if event.envelope.run_id == run]
            if run == case.first_run:
                things = _things(case, events)
                if things is not None:
                    frames[case.name] = things
                continue
            x, y, angle = chance.uniform(-1.0, 1.0, 3).tolist()
            frame = x * _REACH_M, y * _REACH_M, angle * math.pi
            things = _things(case, [_in_frame(event, frame) for event in events])
            if things is not None:
                runs.append((case.name, run, frame, things))
    rows = []
    for name, run, frame, things in runs:
        for other, first in frames.items():
            if other == name:
                rows.append(_row(f"{name} {run}", first, things, frame))
            elif other.split()[0] == name.split()[0]:
                rows.append(_row(f"{name} {run} in {other}", first, things, None))
    return rows


def _things(case: Case, events: Sequence[Accepted]) -> FramedThings | None:
    view = MapView(Settings(fusion="evidence", camera=case.camera_settings))
    for _ in fold_into(view, events):
        pass
    return things_of_map(view)


def _in_frame(event: Accepted, frame: Frame) -> Accepted:
    envelope = event.envelope
    if envelope.map_x is None or envelope.map_y is None or envelope.map_yaw is None:
        return event
    ((x, y),) = moved(np.array([[envelope.map_x, envelope.map_y]]), frame).tolist()
    yaw = math.remainder(envelope.map_yaw + frame[2], math.tau)
    there = msgspec.structs.replace(envelope, map_x=x, map_y=y, map_yaw=yaw)
    return msgspec.structs.replace(event, envelope=there)


def _row(name: str, first: FramedThings, second: FramedThings, frame: Frame | None) -> AlignRow:
    found = align(first, second)
    if found is None:
        return AlignRow(name, "unknown", 0, 0.0, 0.0, math.inf)
    about = name, found.verdict, len(found.pairs), found.score, found.second, found.se_m
    if frame is None:
        return AlignRow(*about)
    here = second.poses[:, :2]
    true = moved(here - frame[:2], (0.0, 0.0, -frame[2]))
    apart = moved(here, found.transform) - true
    turned = math.remainder(found.transform[2] + frame[2], math.tau)
    error = math.sqrt(float((apart * apart).sum(1).mean()))
    return AlignRow(*about, error, abs(math.degrees(turned)))


def align_table(rows: Sequence[AlignRow]) -> str:
    """A line for each run of the same building, then the numbers of both."""
    own = [row for row in rows if row.error_m is not None or " in " not in row.name]
    foreign = [row for row in rows if " in " in row.name]
    header = ["run", "verdict", "common", "score", "next", "± m", "error m", "°"]
    lines = table(header, [_cells(row) for row in own], right=header[2:])
    sure = [row for row in own if row.verdict == "sure"]
    errors = sorted(row.error_m for row in sure if row.error_m is not None)
    verdicts = Counter(row.verdict for row in foreign)
    if not errors:
        return f"{lines}none is sure"
    honest = sum(row.error_m is not None and row.error_m <= 2.0 * row.se_m for row in sure)
    return (
        f"{lines}{len(sure)} of {len(own)} runs are sure, {sum(row.is_right for row in sure)} of "
        f"them right (< {_FAR_M:g} m and < {_TURNED_DEG:g}°), error p50 {np.median(errors):.2f} m,"
        f" p90 {np.percentile(errors, 90):.2f} m, worst {errors[-1]:.2f} m; {honest} within two "
        f"standard errors\n{len(foreign)} of other buildings: {verdicts['sure']} sure, "
        f"{verdicts['likely']} likely, {verdicts['unknown']} cannot be told"
    )


def _cells(row: AlignRow) -> list[str]:
    if row.error_m is None or row.error_deg is None:
        return [row.name, row.verdict, "", "", "", "", "", ""]
    numbers = f"{row.score:.0f}", f"{row.second:.0f}", f"{row.se_m:.2f}", f"{row.error_m:.2f}"
    return [row.name, row.verdict, str(row.common), *numbers, f"{row.error_deg:.1f}"]
