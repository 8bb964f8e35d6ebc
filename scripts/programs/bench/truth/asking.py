"""Scores of `mapfold find`, of goals and of `mapfold changes` on a building in which things were
moved: the table of ``scripts/bench_truth --ask``."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

from eventsrc.base.errors import MisuseError
from projections.ask.find import Wanted, find
from projections.ask.goal_pose import GoalGround
from projections.ask.what_changed import KINDS, map_changes
from projections.localize.evaluate.scores import instances_of
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView

from .scoring import majorities
from .worlds import TrueThing


@dataclass(frozen=True, slots=True)
class AskedRow:
    """``first`` of the ``classes`` found have a true thing of the class as their first answer, as
    far from the truth as ``errors_m``. ``told`` and ``true`` are the changes of each kind: a thing
    of a true change stands elsewhere than in run a. ``goals`` are those of confirmed Objects of
    true things, how many are on free ground, neither wall nor furniture, from how many the
    generator's camera sees the thing, and how many are of things that were moved and not seen
    since, which no goal can know."""

    name: str
    classes: int
    first: int
    errors_m: tuple[float, ...]
    told: tuple[int, ...]
    true: tuple[int, ...]
    goals: tuple[int, ...]


def asked_row(
    name: str,
    before: MapView,
    after: MapView,
    truth: Truth,
    things: Mapping[str, TrueThing],
    synonyms: Mapping[str, Collection[str]],
    building: "Building",
) -> AskedRow:
    """Ask the map of both runs for each class that it has, and what changed since the first.
    ``synonyms`` are the words that a detector has for a class of the truth."""
    owners = majorities(after, truth)
    owner_of = {each.object_id: owners.get(number) for number, each in after.objects.items()}
    classes = sorted({each.class_name for each in after.objects.values() if each.confirmed})
    first, errors = 0, list[float]()
    for class_name in classes:
        found = find(after, Wanted(what=class_name, top=1)).answers[0]
        thing = things.get(owner_of[found.object_id] or "")
        if thing is None or class_name not in (
            thing.class_name,
            *synonyms.get(thing.class_name, ()),
        ):
            continue
        first += 1
        errors.append(math.dist((found.x, found.y), thing.moved_to or (thing.x, thing.y)))
    moved = {thing.instance for thing in things.values() if thing.moved_to is not None}
    last = after.runs[-1].ordinal
    seen_since = {
        instance
        for number, instance in instances_of(after, truth)
        if after.keyframes[after.observations[number].keyframe].run == last
    }
    told, true = dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0)
    was = majorities(before, truth)
    was_of = {each.object_id: was.get(number) for number, each in before.objects.items()}
    for change in map_changes(before, after).changes:
        told[change.kind] += 1
        of = owner_of if change.kind == "new" else was_of
        true[change.kind] += of[change.object_id] in moved
    return AskedRow(
        name,
        len(classes),
        first,
        tuple(errors),
        tuple(told.values()),
        tuple(true.values()),
        building.score_goals(after, owner_of, moved - seen_since),
    )


class Building:
    """A generated building as it stands from run b on, and the camera of a profile in it."""

    def __init__(
        self, generator: ModuleType, world: str, profile: str, moved: float, seed: int
    ) -> None:
        self._world = generator.World(world)
        chance = generator.np.random.default_rng(generator.crc(world, "moved", seed))
        after = generator.moved(self._world, moved, chance) if moved else self._world.objects
        self._world.objects = after
        self._world.place()
        self._camera = generator.Camera(generator.PROFILES[profile], self._world, after)
        self._number = {f"{world}/{thing['id']}": n for n, thing in enumerate(after)}

    def score_goals(
        self, view: MapView, owner_of: Mapping[str, str | None], lost: Collection[str]
    ) -> tuple[int, int, int, int]:
        """Goals, those on free ground, those in view of the thing, and those of things that are
        ``lost``."""
        ground = GoalGround(view)
        goals = free = seen = unknown = 0
        for each in view.objects.values():
            number = self._number.get(owner_of[each.object_id] or "")
            if not each.confirmed or each.missing_in is not None or number is None:
                continue
            try:
                goal = ground.goal(view, each)
            except MisuseError:
                continue
            goals += 1
            unknown += owner_of[each.object_id] in lost
            free += bool(self._world.clear[self._world.cell(goal.x, goal.y)] > 0.0)
            seen += any(hit[0] == number for hit in self._camera.see(goal.x, goal.y, goal.yaw))
        return goals, free, seen, unknown


def asked_table(rows: Sequence[AskedRow]) -> str:
    """A line for each case, the one with the least share of classes found last; then all."""
    heads = [
        "classes",
        "first",
        "share",
        "p50 m",
        *KINDS,
        "precise",
        "goals",
        "free",
        "in view",
        "lost",
    ]
    lines = [_line("find and changes", heads)]
    ordered = sorted(rows, key=lambda row: -_share(row.first, row.classes))
    lines += [_line(row.name, _cells(row)) for row in ordered]
    whole = AskedRow(
        "all",
        sum(row.classes for row in rows),
        sum(row.first for row in rows),
        tuple(error for row in rows for error in row.errors_m),
        tuple(map(sum, zip(*(row.told for row in rows), strict=True))),
        tuple(map(sum, zip(*(row.true for row in rows), strict=True))),
        tuple(map(sum, zip(*(row.goals for row in rows), strict=True))),
    )
    return "\n".join([*lines, _line("all", _cells(whole))])


def _cells(row: AskedRow) -> list[str]:
    errors = sorted(row.errors_m)
    return [
        str(row.classes),
        str(row.first),
        f"{_share(row.first, row.classes):.3f}",
        f"{errors[len(errors) // 2]:.2f}" if errors else "-",
        *(f"{true}/{told}" for true, told in zip(row.true, row.told, strict=True)),
        f"{_share(sum(row.true), sum(row.told)):.3f}" if sum(row.told) else "-",
        str(row.goals[0]),
        *(f"{_share(part, row.goals[0]):.3f}" for part in row.goals[1:3]),
        str(row.goals[3]),
    ]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _line(name: str, cells: Sequence[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(7) for cell in cells)
