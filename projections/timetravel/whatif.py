"""What would have become of a log under other settings, side by side with what it is."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from projections.evaluate.truth import Truth
from projections.partitions import PartitionComparison, Regrouping, compare_partitions
from projections.settings import Settings

from .alternatives import changed_settings, settings_name
from .outcome import Outcome, objects_part, places_part
from .parallel import Progress, fold_all


@dataclass(frozen=True, slots=True)
class Alternative:
    """One alternative beside the base: how its places and objects differ, and since which event.

    ``parted_places`` and ``parted_objects`` are offsets of the first event after which they are
    different, None for never.
    """

    name: str
    outcome: Outcome
    places: PartitionComparison
    objects: PartitionComparison
    parted_places: int | None
    parted_objects: int | None

    @property
    def same(self) -> bool:
        """Whether the map is the base's."""
        return self.places.same and self.objects.same


@dataclass(frozen=True, slots=True)
class WhatIf:
    """The base first, then its alternatives; all of the first ``end`` events of one log."""

    end: int
    base: Alternative
    alternatives: tuple[Alternative, ...]

    @property
    def all(self) -> tuple[Alternative, ...]:
        """The base and its alternatives."""
        return (self.base, *self.alternatives)

    def document(self) -> dict[str, Any]:
        """JSON: settings in full for the base, changed ones for each alternative."""
        base = self.base.outcome.settings
        return {
            "events": self.end,
            "settings": base.model_dump(),
            "base": _document(self.base, base),
            "alternatives": [_document(each, base) for each in self.alternatives],
        }


def what_if(
    log: Path,
    base: Settings,
    others: Sequence[Settings],
    end: int,
    *,
    truth: Truth | None = None,
    processes: int | None = None,
    progress: Progress | None = None,
    keep_views: bool = False,
) -> WhatIf:
    """Fold the first ``end`` events of a log under ``base`` and ``others``, and compare.

    A setting that stands several times is folded once. With ``keep_views`` each outcome has its
    map too.
    """
    wanted = list(dict.fromkeys((base, *others)))
    folded = fold_all(
        log, wanted, end,
        truth=truth, processes=processes, progress=progress, keep_views=keep_views,
    )  # fmt: skip
    outcomes = dict(zip(wanted, folded, strict=True))
    first = outcomes[base]
    changed = base != Settings()
    base_name = f"base: {settings_name(Settings(), base) if changed else 'defaults'}"
    return WhatIf(
        end=end,
        base=_compare(first, first, base_name),
        alternatives=tuple(
            _compare(first, outcomes[each], settings_name(base, each)) for each in others
        ),
    )


def _compare(base: Outcome, other: Outcome, name: str) -> Alternative:
    posed = base.posed
    return Alternative(
        name=name,
        outcome=other,
        places=compare_partitions(
            [base.places[k] for k in posed], [other.places[k] for k in posed]
        ),
        objects=compare_partitions(base.objects, other.objects),
        parted_places=places_part(base, other),
        parted_objects=objects_part(base, other),
    )


def _document(each: Alternative, base: Settings) -> dict[str, Any]:
    outcome, counts = each.outcome, each.outcome.counts
    return {
        "set": changed_settings(base, outcome.settings),
        "digest": outcome.digest,
        "places": counts["places"],
        "noise": counts["noise"],
        "merges": outcome.merges,
        "objects": counts["objects"],
        "same": each.same,
        "places_adjusted_rand": float(each.places.adjusted_rand),
        "objects_adjusted_rand": float(each.objects.adjusted_rand),
        "places_part_at": each.parted_places,
        "objects_part_at": each.parted_objects,
        "places_split": [_regrouping(found) for found in each.places.splits],
        "places_joined": [_regrouping(found) for found in each.places.joins],
        "objects_split": len(each.objects.splits),
        "objects_joined": len(each.objects.joins),
        "truth": outcome.scores,
        "fold_seconds": round(outcome.seconds, 3),
    }


def _regrouping(found: Regrouping) -> dict[str, Any]:
    return {
        "place_id": found.group,
        "pieces": [{"place_id": p.group, "keyframes": p.count} for p in found.pieces],
    }
