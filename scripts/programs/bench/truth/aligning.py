"""Whether runs in frames of their own find each other, and runs of other buildings do not: the
table of ``scripts/bench_truth --align``.

Each later run of a building, its frame moved at random, against run a, and every run against those
of the other buildings of the same robot; both whole and in thirds. With ``--jumps``: runs whose
frame is set wrong in the middle, and runs as they are.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import msgspec
import numpy as np

from eventsrc.base.text import table
from eventsrc.envelope.ingest import Accepted
from projections.fold.settings import Settings
from projections.localize.align.alignment import Alignment, align
from projections.localize.align.framed_things import FramedThings, things_of_map
from projections.localize.align.jumps import find_jumps
from projections.localize.align.matching import moved
from projections.map.view import MapView

from .folding import fold_into
from .worlds import Case

Frame = tuple[float, float, float]
_FAR_M, _TURNED_DEG = 1.0, 10.0
_REACH_M = 20.0
_BACK_M: Final = 0.5
_COMMON: Final = (0, 8, 12, 20)
"""Thirds of runs stand in the row of the largest of these numbers of common things they reach."""


@dataclass(frozen=True, slots=True)
class AlignRow:
    """A run, or a third of one, whose frame was moved at random, brought back into that of run a,
    or a third of it.

    ``in_common`` is how many things both truly saw, unmoved; None in another building. Of the
    keyframes and the angle an error is known where a transform of the same building was found.
    """

    name: str
    is_whole: bool
    in_common: int | None
    verdict: str
    common: int = 0
    score: float = 0.0
    second: float = 0.0
    se_m: float = math.inf
    error_m: float | None = None
    error_deg: float | None = None

    @property
    def is_right(self) -> bool:
        """Whether the transform is near the true one."""
        if self.error_m is None or self.error_deg is None:
            return False
        return self.error_m < _FAR_M and self.error_deg < _TURNED_DEG


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A run or a third of one, mapped alone; which things it truly saw."""

    is_whole: bool
    frame: Frame
    things: FramedThings
    seen: frozenset[str]


def align_rows(cases: Iterable[Case], seed: int) -> Iterator[AlignRow]:
    """All parts of a building's later runs against all parts of its run a, and all parts of every
    two runs of two buildings of the same robot; each run is mapped once."""
    chance = np.random.default_rng(seed)
    runs: dict[str, list[tuple[str, str, list[_Part]]]] = {}
    for case in cases:
        profile = case.name.split()[0]
        for run in dict.fromkeys(event.envelope.run_id for event in case.events):
            events = [event for event in case.events if event.envelope.run_id == run]
            x, y, angle = chance.uniform(-1.0, 1.0, 3).tolist()
            frame = x * _REACH_M, y * _REACH_M, angle * math.pi
            parts = list(_parts(case, events, (0.0, 0.0, 0.0) if run == case.first_run else frame))
            for other, name, known in runs.get(profile, []):
                is_there = other == case.name
                if is_there and not name.endswith(case.first_run):
                    continue
                where = f"{case.name} {run}" + ("" if is_there else f" in {name}")
                for one, part in product(known, parts):
                    yield _row(where, one, part, is_there=is_there)
            runs.setdefault(profile, []).append((case.name, f"{case.name} {run}", parts))


def _parts(case: Case, events: Sequence[Accepted], frame: Frame) -> Iterator[_Part]:
    """A run and its thirds, in a frame of their own; without those that have nothing to compare."""
    third = -(-len(events) // 3)
    for first, size in (0, len(events)), (0, third), (third, third), (2 * third, third):
        part = events[first : first + size]
        things = things_of_map(_map(case, [_in_frame(event, frame) for event in part]))
        if things is not None:
            yield _Part(size == len(events), frame, things, frozenset(_seen(case, part)))


def _map(case: Case, events: Sequence[Accepted]) -> MapView:
    view = MapView(Settings(fusion="evidence", camera=case.camera_settings))
    for _ in fold_into(view, events):
        pass
    return view


def _seen(case: Case, events: Sequence[Accepted]) -> Iterator[str]:
    for event in events:
        key = event.envelope.run_id, event.envelope.keyframe_id
        for instance in case.truth.keyframes[key].instances if key in case.truth.keyframes else ():
            if instance is not None and _is_left(case, instance):
                yield instance


def _is_left(case: Case, instance: str) -> bool:
    thing = case.things.get(instance)
    return thing is None or thing.moved_to is None


def _bare(event: Accepted) -> Accepted:
    """The keyframe without what was seen."""
    return Accepted(msgspec.structs.replace(event.envelope, detections=()), (), ())


def _in_frame(event: Accepted, frame: Frame) -> Accepted:
    envelope = event.envelope
    if envelope.map_x is None or envelope.map_y is None or envelope.map_yaw is None:
        return event
    ((x, y),) = moved(np.array([[envelope.map_x, envelope.map_y]]), frame).tolist()
    yaw = math.remainder(envelope.map_yaw + frame[2], math.tau)
    there = msgspec.structs.replace(envelope, map_x=x, map_y=y, map_yaw=yaw)
    return msgspec.structs.replace(event, envelope=there)


def _row(name: str, first: _Part, second: _Part, *, is_there: bool) -> AlignRow:
    is_whole = first.is_whole and second.is_whole
    in_common = len(first.seen & second.seen) if is_there else None
    found = align(first.things, second.things)
    if found is None:
        return AlignRow(name, is_whole, in_common, "unknown")
    numbers = len(found.pairs), found.score, found.second, found.se_m
    errors = _errors(second, found) if is_there else (None, None)
    return AlignRow(name, is_whole, in_common, found.verdict, *numbers, *errors)


def _errors(second: _Part, found: Alignment) -> tuple[float, float]:
    """Of the keyframes, metres, root mean square, and of the angle, degrees."""
    frame, here = second.frame, second.things.poses[:, :2]
    true = moved(here - frame[:2], (0.0, 0.0, -frame[2]))
    apart = moved(here, found.transform) - true
    turned = math.remainder(found.transform[2] + frame[2], math.tau)
    return math.sqrt(float((apart * apart).sum(1).mean())), abs(math.degrees(turned))


def align_table(rows: Sequence[AlignRow]) -> str:
    """A line for each whole run of the same building, then the numbers of all."""
    own = [row for row in rows if row.in_common is not None]
    header = ["run", "verdict", "common", "score", "next", "± m", "error m", "°"]
    whole = [row for row in own if row.is_whole]
    foreign = [row for row in rows if row.in_common is None]
    return (
        table(header, [_cells(row) for row in whole], right=header[2:])
        + f"whole runs: {_whole_text(whole)}\n"
        + "".join(_parts_lines([row for row in own if not row.is_whole]))
        + f"other buildings, whole: {_foreign_text([row for row in foreign if row.is_whole])}\n"
        + f"other buildings, thirds: {_foreign_text([r for r in foreign if not r.is_whole])}"
    )


def _whole_text(rows: Sequence[AlignRow]) -> str:
    sure = [row for row in rows if row.verdict == "sure"]
    errors = sorted(row.error_m for row in sure if row.error_m is not None)
    if not errors:
        return f"none of {len(rows)} is sure"
    honest = sum(row.error_m is not None and row.error_m <= 2.0 * row.se_m for row in sure)
    return (
        f"{len(sure)} of {len(rows)} are sure, {sum(row.is_right for row in sure)} of "
        f"them right (< {_FAR_M:g} m and < {_TURNED_DEG:g}°), error p50 {np.median(errors):.2f} m,"
        f" p90 {np.percentile(errors, 90):.2f} m, worst {errors[-1]:.2f} m; {honest} within two "
        "standard errors"
    )


def _parts_lines(rows: Sequence[AlignRow]) -> Iterator[str]:
    """How many parts of runs are sure and right, by how much they have in common."""
    for least, end in zip(_COMMON, [*_COMMON[1:], math.inf], strict=True):
        some = [row for row in rows if least <= (row.in_common or 0) < end]
        sure = [row for row in some if row.verdict == "sure"]
        right = sum(row.is_right for row in sure)
        named = f"{least} or more" if end == math.inf else f"{least} to {end - 1:g}"
        yield (
            f"thirds with {named} things in common: {right} of {len(some)} sure and right, "
            f"{len(sure) - right} sure and wrong\n"
        )


def _foreign_text(rows: Sequence[AlignRow]) -> str:
    verdicts = Counter(row.verdict for row in rows)
    named = f"{verdicts['sure']} sure, {verdicts['likely']} likely, {verdicts['unknown']} not told"
    return f"{len(rows)}: {named}"


def _cells(row: AlignRow) -> list[str]:
    if row.error_m is None or row.error_deg is None:
        return [row.name, row.verdict, "", "", "", "", "", ""]
    numbers = f"{row.score:.0f}", f"{row.second:.0f}", f"{row.se_m:.2f}", f"{row.error_m:.2f}"
    return [row.name, row.verdict, str(row.common), *numbers, f"{row.error_deg:.1f}"]


@dataclass(frozen=True, slots=True)
class JumpRow:
    """A run whose tail was moved by ``jump_m`` (None: left as it is), alone in the log or behind
    run a; whether a jump was found, and how far the tail is from its place afterwards."""

    name: str
    is_alone: bool
    jump_m: float | None
    verdict: str
    is_there: bool = False
    error_m: float | None = None


def jump_rows(case: Case, chance: np.random.Generator) -> Iterator[JumpRow]:
    """The later runs of a case with and without a jump."""
    runs: dict[str, list[Accepted]] = {}
    for event in case.events:
        runs.setdefault(event.envelope.run_id, []).append(event)
    for run, events in runs.items():
        if run == case.first_run:
            yield _jump_row(case, run, events, [], None)
            continue
        poses = [(e.envelope.map_x, e.envelope.map_y) for e in events]
        start = int(chance.uniform(0.4, 0.6) * len(events))
        length, way = float(chance.uniform(2.0, 8.0)), float(chance.uniform(-math.pi, math.pi))
        turn = 0.0 if chance.random() < 0.3 else float(chance.uniform(-math.pi, math.pi))
        pivot = np.array([poses[start]], dtype=float)
        to = pivot + length * np.array([math.cos(way), math.sin(way)])
        x, y = (to - moved(pivot, (0.0, 0.0, turn)))[0].tolist()
        wrong = [*events[:start], *(_in_frame(event, (x, y, turn)) for event in events[start:])]
        for others in ([], runs[case.first_run]):
            yield _jump_row(case, run, events, others, None)
            yield _jump_row(case, run, wrong, others, (start, length, (x, y, turn)))


def _jump_row(
    case: Case,
    run: str,
    events: Sequence[Accepted],
    others: Sequence[Accepted],
    jump: tuple[int, float, Frame] | None,
) -> JumpRow:
    about = f"{case.name} {run}", not others, None if jump is None else jump[1]

    steps = find_jumps(
        _map(case, list(map(_bare, events))).keyframes,
        lambda s: things_of_map(_map(case, [e for e in events if s.has(e.envelope.keyframe_id)])),
        lambda s: things_of_map(
            _map(case, [*others, *(e for e in events if not s.has(e.envelope.keyframe_id))])
        ),
    )
    told = [(each.stretch, each.found) for each in steps if each.is_jump and each.found is not None]
    if not told:
        return JumpRow(*about, "none")
    stretch, found = told[0]
    if jump is None or len(told) > 1:
        return JumpRow(*about, found.verdict)
    start, _, frame = jump
    here = np.array([(e.envelope.map_x, e.envelope.map_y) for e in events[start:]], dtype=float)
    true = moved(here - frame[:2], (0.0, 0.0, -frame[2]))
    apart = moved(here, found.transform) - true
    is_there = stretch == (events[start].envelope.keyframe_id, None)
    error = math.sqrt(float((apart * apart).sum(1).mean()))
    return JumpRow(*about, found.verdict, is_there, error)


def jump_table(rows: Sequence[JumpRow]) -> str:
    """How many tails come right, and how often a jump is seen where there is none."""
    lines = []
    for is_alone, named in (True, "alone"), (False, "behind run a"):
        clean = [r for r in rows if r.is_alone == is_alone and r.jump_m is None]
        jumped = [r for r in rows if r.is_alone == is_alone and r.jump_m is not None]
        told = [r for r in jumped if r.verdict != "none"]
        right = [r for r in told if r.is_there and r.error_m is not None and r.error_m < _BACK_M]
        sure = sum(r.verdict == "sure" for r in right)
        lines.append(
            f"{named}: {len(right)} of {len(jumped)} tails right within {_BACK_M:g} m ({sure} of"
            f" them sure), {len(told) - len(right)} wrong; in {len(clean)} clean runs"
            f" {sum(r.verdict != 'none' for r in clean)} false alarms"
        )
    return "\n".join(lines)
