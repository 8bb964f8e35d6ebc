"""Facts of fusion by evidence about an object, as text and as JSON.

Where it stands and how sure that is, the votes of classes, why objects were fused, since when it is
missing and where it moved.
"""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold.deltas import MergeEvidence, ObjectEstimated, ObjectMissing
from projections.fold.exact import UM_PER_M
from projections.map.records import Estimate
from projections.store.history import History
from projections.store.records import ObjectHistory, last_before

_NATS = 1000


def evidence_text(evidence: MergeEvidence | None) -> str:
    """``0.34 m apart, looks +3.2, positions +1.1, in one picture 0 of 12 times``; looks and
    positions are log-likelihood ratios in nats. None stands for a merge by a command."""
    if evidence is None:
        return "a command"
    return (
        f"{evidence.distance_um / UM_PER_M:.2f} m apart, looks {evidence.look / _NATS:+.1f}, "
        f"positions {evidence.geometry / _NATS:+.1f}, "
        f"in one picture {evidence.pictures_with_both:,} of {counted(evidence.pictures, 'time')}"
    )


def evidence_document(evidence: MergeEvidence) -> dict[str, Any]:
    """The evidence of a merge of objects as JSON; log-likelihood ratios in nats."""
    return {
        "distance_m": evidence.distance_um / UM_PER_M,
        "look": evidence.look / _NATS,
        "geometry": evidence.geometry / _NATS,
        "pictures_with_both": evidence.pictures_with_both,
        "pictures": evidence.pictures,
    }


def standing_text(history: History, record: ObjectHistory, end: Offset) -> str:
    """``; stands at (1.20, 3.40) ± 0.12 m, seen from 3 spots; missing since …``; empty without an
    estimate."""
    estimated = last_before(record.estimates, end)
    if estimated is None:
        return ""
    text = f"; stands at {_where(estimated)}, seen from {counted(estimated.spots, 'spot')}"
    since = _missing_since(record, end)
    if since is not None:
        looked = record.looked_for(end)
        misses = 0 if looked is None else looked.misses
        cause = history.cause_at(since)
        text += (
            f"; missing since offset {since:,} ({cause.title}): "
            f"not seen in {counted(misses, 'keyframe')} that should show it"
        )
    return text


def votes_text(votes: Counter[str]) -> str:
    """`` (chair ×5, stool ×1)`` where classes differ, else nothing."""
    if len(votes) < 2:
        return ""
    return f" ({', '.join(f'{name} ×{count}' for name, count in _ordered(votes))})"


def evidence_facts(record: ObjectHistory, votes: Counter[str], end: Offset) -> dict[str, Any]:
    """The object's estimate, votes of classes and presence as JSON."""
    estimated = last_before(record.estimates, end)
    if estimated is None:
        return {}
    looked = record.looked_for(end)
    return {
        "estimate": {
            "x": estimated.x_um / UM_PER_M,
            "y": estimated.y_um / UM_PER_M,
            "sigma_m": _sigma_m(estimated),
            "spots": estimated.spots,
        },
        "class_counts": dict(_ordered(votes)),
        "missing": looked is not None and looked.missing,
        "misses": 0 if looked is None else looked.misses,
    }


def _ordered(votes: Counter[str]) -> list[tuple[str, int]]:
    return sorted(votes.items(), key=lambda item: (-item[1], item[0]))


def evidence_entries(
    record: ObjectHistory,
) -> Iterator[tuple[Offset, str, str, dict[str, Any]]]:
    """Offset, kind, text and facts of each of the object's events that only fusion by evidence
    has."""
    spots = 0
    for estimated in record.estimates:
        if _is_milestone(spots, estimated.spots):
            text = f"stands at {_where(estimated)}, seen from {counted(estimated.spots, 'spot')}"
            facts: dict[str, Any] = {
                "x": estimated.x_um / UM_PER_M,
                "y": estimated.y_um / UM_PER_M,
                "sigma_m": _sigma_m(estimated),
                "spots": estimated.spots,
            }
            yield estimated.offset, "estimated", text, facts
        spots = max(spots, estimated.spots)
    name = record.found.class_name
    for classified in record.classes:
        if classified.class_name != name:
            text = f"called {classified.class_name} instead of {name}: most sightings say so"
            yield classified.offset, "classified", text, {"from": name, "to": classified.class_name}
            name = classified.class_name
    was_missing = False
    for offset, looked in _presence(record):
        is_missing = looked is not None and looked.missing
        if looked is not None and is_missing and not was_missing:
            text = f"missing: not seen in {counted(looked.misses, 'keyframe')} that should show it"
            yield offset, "missing", text, {"misses": looked.misses}
        elif looked is not None and was_missing and not is_missing:
            yield offset, "back", "seen where it was missing", {}
        was_missing = is_missing
    for moved in record.relocations:
        start, stop = (moved.from_x_um, moved.from_y_um), (moved.to_x_um, moved.to_y_um)
        text = (
            f"moved {math.dist(start, stop) / UM_PER_M:.2f} m, "
            f"from {_point(start)} to {_point(stop)}"
        )
        facts = {
            "from": [value / UM_PER_M for value in start],
            "to": [value / UM_PER_M for value in stop],
        }
        yield moved.offset, "moved", text, facts


def _presence(record: ObjectHistory) -> list[tuple[Offset, ObjectMissing | None]]:
    """The object's missed sightings by offset, with None for each relocation, in order."""
    moved = [(each.offset, None) for each in record.relocations]
    looked = [(each.offset, each) for each in record.misses]
    return sorted([*moved, *looked], key=lambda event: event[0])


def _missing_since(record: ObjectHistory, end: Offset) -> Offset | None:
    """The event below ``end`` since which the object is missing; None if it is not."""
    since = None
    for offset, looked in _presence(record):
        if offset >= end:
            break
        if looked is None or not looked.missing:
            since = None
        elif since is None:
            since = offset
    return since


def _is_milestone(before: int, after: int) -> bool:
    """Whether a number of spots passed one of 1, 2, 3, 5, 10, 100 …"""
    return any(before < step <= after for step in (1, 2, 3, 5)) or (
        after >= 10 and len(str(after)) > len(str(before))
    )


def _where(estimated: ObjectEstimated) -> str:
    return f"{_point((estimated.x_um, estimated.y_um))} ± {_sigma_m(estimated):.2f} m"


def _point(position_um: tuple[int, int]) -> str:
    x, y = (value / UM_PER_M for value in position_um)
    return f"({x:.2f}, {y:.2f})"


def _sigma_m(e: ObjectEstimated) -> float:
    return Estimate(e.x_um, e.y_um, e.var_xx_um2, e.var_xy_um2, e.var_yy_um2, e.spots).est_sigma_m
