"""What a way to a map gives, as plain data that must be equal for all ways."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.map_errors import FoldError
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings
from projections.history.known_history import KnownHistory
from projections.history.merge_reasons import (
    merge_document,
    object_merge_document,
    refusal_document,
)
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from tests.support.histories import whole

CHOICES = [
    *((name, *assignments) for name, assignments in PRESETS.items()),
    ("classic, close together", "eps_m=0.7", "fusion_radius_m=2.0"),
    ("evidence", "fusion=evidence", "eps_m=0.8"),
]
"""Settings that a log is folded under where it names none: a name, and assignments."""


@dataclass(frozen=True)
class Chosen:
    """The settings that the log names, or others."""

    otherwise: Settings

    def __call__(self, corrections: Corrections) -> Settings:
        return corrections.settings or self.otherwise


class Differs(AssertionError):
    """Two ways give different maps or answers."""


@dataclass
class Tally:
    """Counts over all logs."""

    logs: int = 0
    prefixes: int = 0
    comparisons: int = 0
    by_way: dict[str, int] = field(default_factory=dict)

    def compare(self, way: str, found: Any, expected: Any, where: object) -> None:
        """Raises Differs, which names the way and the first part that is different."""
        self.comparisons += 1
        self.by_way[way] = self.by_way.get(way, 0) + 1
        if found != expected:
            raise Differs(f"{way}, at {where}: {_difference(found, expected)}")


def _difference(found: Any, expected: Any, path: str = "") -> str:
    """The first part that differs."""
    if isinstance(found, dict) and isinstance(expected, dict):
        pairs = [(key, found.get(key), expected.get(key)) for key in {**found, **expected}]
    elif isinstance(found, list | tuple) and isinstance(expected, list | tuple):
        pairs = [(n, a, b) for n, (a, b) in enumerate(zip(found, expected, strict=False))]
        if len(found) != len(expected):
            pairs.append(("length", len(found), len(expected)))
    else:
        pairs = []
    for key, one, other in pairs:
        if one != other:
            return _difference(one, other, f"{path}/{key}")
    return f"{path or '/'}: {str(found)[:300]} instead of {str(expected)[:300]}"


def outcome(ask: Callable[[], Any]) -> Any:
    """What ``ask`` returns, or why it is refused: the kind of error, and the event."""
    try:
        return ask()
    except FoldError as error:
        return type(error).__name__, error.offset
    except MisuseError as error:
        return type(error).__name__, str(error)
    except MapfoldError as error:
        return (type(error).__name__,)


def folded(log: Path, settings: Chosen, end: int, known_at: int) -> Any:
    """The map after ``end`` events under the commands before ``known_at``, by a fold of its own
    from the first event."""

    def fold() -> Any:
        with LogReader(log) as reader:
            corrections = read_corrections(reader, Offset(known_at))
            chosen = settings(corrections)
            return whole(
                fold_log(
                    reader, chosen, Offset(end), keep_embeddings=False, corrections=corrections
                )[1]
            )

    return outcome(fold)


def stories(known: KnownHistory, end: int, rng: random.Random) -> Any:
    """Answers about the map after ``end`` events, and about some things that are in it."""
    at = Offset(end)

    def tell() -> Any:
        view, history = known.at(at), known.covering(at)
        places = [place.place_id for place in view.all_places]
        objects = [found.object_id for found in view.all_objects]
        names = [f"{k.run_id}:{k.keyframe_id}" for k in view.keyframes]
        asked = [rng.choice(each) for each in (places, objects) if each]
        pair = [rng.choice(names), rng.choice(names)] if names else []
        conditions = ["place_count == 2", "noise_count > 2", "object_count >= 5"]
        conditions += [f"same_place({pair[0]!r}, {pair[1]!r})"] if pair else []
        conditions += [f"size({place!r}) > 3" for place in places[:1]]
        return {
            "merges": [merge_document(history, merge) for merge in known.merges(at)],
            "refusals": [refusal_document(history, each) for each in known.refusals(at)],
            "objects": [object_merge_document(history, each) for each in known.object_merges(at)],
            "why": [known.why(thing, at).document() for thing in asked],
            "same": known.why_same(*pair, at).document() if pair else None,
            "bisect": [known.bisect(each, end=at).document() for each in conditions],
            "deltas": [each.offset for each in known.deltas(end=at)],
        }

    return outcome(tell)
