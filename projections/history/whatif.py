"""What-if: maps of one log under other settings or without a command, compared with the base's
map."""

from array import array
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from eventsrc.envelope.model import DetId, Offset
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.map_errors import SettingsError
from projections.fold.settings import Settings, assignment_texts
from projections.map.naming import NoSuchThing, ShortIds
from projections.map.partitions import PartitionComparison, Regrouping, compare_partitions
from projections.map.phrases import command_document, command_name
from projections.store.history import NEVER

from .known_history import Progress
from .rule_folds import NO_NUMBER, FoldResult, Rules, fold_all

if TYPE_CHECKING:
    from projections.localize.evaluate.truth import Truth

MOST_ALTERNATIVES = 200

_K = TypeVar("_K", bound=Hashable)
_V = TypeVar("_V")


def alternatives(
    base: Settings, sets: Sequence[str], tries: Sequence[str], grids: Sequence[str]
) -> list[Settings]:
    """The alternative settings of ``--set``, ``--try`` and ``--grid``, each once, in the order
    given.

    ``sets`` together make one alternative (``eps_m=1.0``), and hold for all of the grid; each of
    ``tries`` is one alternative of assignments separated by spaces or commas; ``grids``
    (``eps_m=0.5,1.0``) make every combination. Raises SettingsError that names the bad one.
    """
    common = base.with_assignments(sets)
    axes = [_axis(text) for text in grids]
    size = len(tries)
    for axis in axes:
        size = max(size, 1) * len(axis)
    if size > MOST_ALTERNATIVES:
        raise SettingsError(f"--grid: {size:,} combinations; try at most {MOST_ALTERNATIVES}")
    found = [common] if sets and not axes else []
    found += [assigned(base, text, "--try") for text in tries]
    if axes:
        found += [common.with_assignments(each, "--grid") for each in product(*axes)]
    return list(dict.fromkeys(found))


def without_command(
    commands: Sequence[RecordedCommand], command_id: str
) -> tuple[RecordedCommand, Corrections]:
    """The command of this id, and the corrections of the others. Raises NoSuchThing."""
    for recorded in commands:
        if recorded.command.command_id == command_id:
            others = [each for each in commands if each is not recorded]
            return recorded, compile_corrections(others)
    raise NoSuchThing("command", command_id, [c.command.command_id for c in commands])


def assigned(settings: Settings, text: str, option: str) -> Settings:
    """``settings`` changed by the assignments in the text of an option, separated by spaces or
    commas."""
    return settings.with_assignments(text.replace(",", " ").split(), option)


def _axis(text: str) -> list[str]:
    """``eps_m=0.5,1.0`` → ``eps_m=0.5``, ``eps_m=1.0``."""
    name, equals, values = text.partition("=")
    if not equals or not values.strip():
        raise SettingsError(f"--grid {text}: write it as name=value,value such as eps_m=0.5,1.0")
    return [f"{name}={value}" for value in values.split(",")]


def settings_name(base: Settings, other: Settings) -> str:
    """``eps_m=1.0 min_samples=8``: the settings that differ from the base."""
    changed = other.changed_from(base)
    return " ".join(assignment_texts(changed)) or "no change"


@dataclass(frozen=True, slots=True)
class Alternative:
    """One alternative compared with the base.

    ``places_part_at`` and ``objects_part_at`` are the offsets of the first event after which the
    places or objects of the two folds differ, None for never. ``renamed`` gives, by id, the names
    of places in the base and here, where they differ. ``without`` is the command left out.
    """

    name: str
    result: FoldResult
    places: PartitionComparison
    objects: PartitionComparison
    places_part_at: Offset | None
    objects_part_at: Offset | None
    renamed: dict[str, tuple[str | None, str | None]]
    without: RecordedCommand | None = None

    @property
    def same(self) -> bool:
        """Whether the places and objects are the base's."""
        return self.places.same and self.objects.same


@dataclass(frozen=True, slots=True)
class WhatIf:
    """The base first, then its alternatives; all of the first ``end`` events of one log.

    ``corrections`` is the fingerprint of the base's, empty without any.
    """

    end: Offset
    base: Alternative
    alternatives: tuple[Alternative, ...]
    corrections: str = ""

    @property
    def all(self) -> tuple[Alternative, ...]:
        """The base and its alternatives."""
        return (self.base, *self.alternatives)

    def short_ids(self) -> ShortIds:
        """The short ids of the places of all these maps together."""
        results = [each.result for each in self.all]
        places = [{*result.places, *result.names} - {None} for result in results]
        names = [name for result in results for name in result.names.values()]
        return ShortIds(sorted({place for each in places for place in each if place}), (), names)

    def document(self) -> dict[str, Any]:
        """JSON: settings in full for the base, changed ones for each alternative."""
        base = self.base.result.settings
        return {
            "events": self.end,
            "settings": base.model_dump(),
            **({"corrections": self.corrections} if self.corrections else {}),
            "base": _document(self.base, base),
            "alternatives": [_document(each, base) for each in self.alternatives],
        }


@dataclass(frozen=True, slots=True)
class TrialRules:
    """One alternative to try: its name and rules, and the command that it leaves out."""

    name: str
    rules: Rules
    without: RecordedCommand | None = None


def setting_trials(base: Rules, others: Sequence[Settings]) -> list[TrialRules]:
    """A trial for each of other settings, under the base's corrections."""
    return [
        TrialRules(settings_name(base.settings, each), Rules(each, base.corrections))
        for each in others
    ]


def command_trials(
    commands: Sequence[RecordedCommand],
    command_ids: Sequence[str],
    settings: Callable[[Corrections], Settings],
) -> list[TrialRules]:
    """A trial for each of some commands that is left out. Raises NoSuchThing."""
    trials = []
    for command_id in dict.fromkeys(command_ids):
        recorded, corrections = without_command(commands, command_id)
        rules = Rules(settings(corrections), corrections)
        trials.append(TrialRules(f"without {command_name(recorded.command)}", rules, recorded))
    return trials


def what_if(
    log: Path,
    base: Rules | Settings,
    others: Sequence[TrialRules | Settings],
    end: Offset,
    *,
    truth: "Truth | None" = None,
    processes: int | None = None,
    progress: Progress | None = None,
    keep_views: bool = False,
) -> WhatIf:
    """Fold the first ``end`` events of a log under ``base`` and ``others``, and compare.

    Equal rules are folded once. With ``keep_views`` each result has its map too.
    """
    rules = base if isinstance(base, Rules) else Rules(base)
    trials = [
        setting_trials(rules, [each])[0] if isinstance(each, Settings) else each for each in others
    ]
    wanted = {each.key: each for each in (rules, *(trial.rules for trial in trials))}
    folded = fold_all(
        log, list(wanted.values()), end,
        truth=truth, processes=processes, progress=progress, keep_views=keep_views,
    )  # fmt: skip
    results = dict(zip(wanted, folded, strict=True))
    first = results[rules.key]
    changed = rules.settings != Settings()
    name = settings_name(Settings(), rules.settings) if changed else "defaults"
    return WhatIf(
        end=end,
        base=_compare(first, first, TrialRules(f"base: {name}", rules)),
        alternatives=tuple(_compare(first, results[trial.rules.key], trial) for trial in trials),
        corrections=rules.corrections.fingerprint(),
    )


def _compare(base: FoldResult, other: FoldResult, trial: TrialRules) -> Alternative:
    base, other = _aligned(base, other)
    posed = sorted({*base.posed, *other.posed})
    return Alternative(
        name=trial.name,
        result=other,
        places=compare_partitions(
            [base.places[k] for k in posed], [other.places[k] for k in posed]
        ),
        objects=compare_partitions(base.objects, other.objects),
        places_part_at=_places_part_at(base, other),
        objects_part_at=_objects_part_at(base, other),
        renamed={
            place: (base.names.get(place), other.names.get(place))
            for place in sorted(base.names.keys() | other.names.keys())
            if base.names.get(place) != other.names.get(place)
        },
        without=trial.without,
    )


def _aligned(first: FoldResult, second: FoldResult) -> tuple[FoldResult, FoldResult]:
    """Both results over the union of their keyframes and observations, in the order of the log.

    Under other settings a log has the same ones; corrections leave some out. A keyframe is known by
    its event, an observation by its event and det_id. A keyframe that one fold left out is in no
    place in its result, an observation of no object.
    """
    if (
        first.keyframe_offsets == second.keyframe_offsets
        and first.observation_offsets == second.observation_offsets
        and first.det_ids == second.det_ids
    ):
        return first, second
    keyframes = sorted({*first.keyframe_offsets, *second.keyframe_offsets})
    observations = sorted({*_observations(first), *_observations(second)})
    return _with(first, keyframes, observations), _with(second, keyframes, observations)


def _observations(result: FoldResult) -> list[tuple[int, DetId]]:
    return list(zip(result.observation_offsets, result.det_ids, strict=True))


def _with(
    result: FoldResult, keyframes: list[int], observations: list[tuple[int, DetId]]
) -> FoldResult:
    """The result extended to these keyframes and observations, which include all of its own."""
    own = {offset: ordinal for ordinal, offset in enumerate(result.keyframe_offsets)}
    posed = {result.keyframe_offsets[ordinal] for ordinal in result.posed}
    seen = {key: ordinal for ordinal, key in enumerate(_observations(result))}
    return replace(
        result,
        places=tuple(_values(keyframes, own, result.places, None)),
        posed=array("q", (i for i, offset in enumerate(keyframes) if offset in posed)),
        keyframe_offsets=array("q", keyframes),
        placed_offsets=array("q", _values(keyframes, own, result.placed_offsets, int(NEVER))),
        placed_in=array("q", _values(keyframes, own, result.placed_in, NO_NUMBER)),
        objects=tuple(_values(observations, seen, result.objects, None)),
        fused_into=array("q", _values(observations, seen, result.fused_into, NO_NUMBER)),
        observation_offsets=array("q", (offset for offset, _ in observations)),
        det_ids=tuple(det_id for _, det_id in observations),
    )


def _values(
    keys: Sequence[_K], ordinals: Mapping[_K, int], values: Sequence[_V], missing: _V
) -> list[_V]:
    """The value of each key, ``missing`` for one that has none."""
    return [missing if (at := ordinals.get(key)) is None else values[at] for key in keys]


def _places_part_at(first: FoldResult, second: FoldResult) -> Offset | None:
    """The first event after which the places of two folds of one log differ; None for never."""
    placings = zip(
        first.placed_offsets, first.placed_in, second.placed_offsets, second.placed_in, strict=True
    )
    differ = [min(o1, o2) for o1, p1, o2, p2 in placings if (o1, p1) != (o2, p2)]
    differ += [offset for offset, _, _ in set(first.merged) ^ set(second.merged)]
    return Offset(min(differ)) if differ else None


def _objects_part_at(first: FoldResult, second: FoldResult) -> Offset | None:
    """The first event after which the objects of two folds of one log differ; None for never."""
    pairs = zip(first.fused_into, second.fused_into, first.observation_offsets, strict=True)
    differ = [next((offset for a, b, offset in pairs if a != b), None)]
    differ += [offset for offset, _, _ in set(first.fused_later) ^ set(second.fused_later)]
    offsets = [offset for offset in differ if offset is not None]
    return Offset(min(offsets)) if offsets else None


def _document(each: Alternative, base: Settings) -> dict[str, Any]:
    result, counts = each.result, each.result.counts
    return {
        "set": result.settings.changed_from(base),
        "digest": result.digest,
        "places": counts["places"],
        "noise": counts["noise"],
        "merges": result.merges,
        "objects": counts["objects"],
        "same": each.same,
        "places_adjusted_rand": float(each.places.adjusted_rand),
        "objects_adjusted_rand": float(each.objects.adjusted_rand),
        "places_part_at": each.places_part_at,
        "objects_part_at": each.objects_part_at,
        "places_split": [_regrouping(found) for found in each.places.splits],
        "places_joined": [_regrouping(found) for found in each.places.joins],
        "objects_split": len(each.objects.splits),
        "objects_joined": len(each.objects.joins),
        "truth": result.scores,
        "fold_seconds": round(result.seconds, 3),
        **({} if each.without is None else {"without": command_document(each.without)}),
        **({"renamed": _renamed(each)} if each.renamed else {}),
    }


def _renamed(each: Alternative) -> list[dict[str, str | None]]:
    return [
        {"place_id": place, "base": before, "name": after}
        for place, (before, after) in each.renamed.items()
    ]


def _regrouping(found: Regrouping) -> dict[str, Any]:
    return {
        "place_id": found.group,
        "pieces": [{"place_id": p.group, "keyframes": p.count} for p in found.pieces],
    }
