"""The page's facts about a whole log, as JSON."""

import resource
import sys
from typing import Any, Final

from eventsrc.base.text import visible
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.map.wall_segments import wall_segments

from .log_map import MOST_ALTERNATIVES, MOST_HISTORIES, LogMap
from .opened import Opened

_KIB: Final = 1 if sys.platform == "darwin" else 1024
"""The unit of ``ru_maxrss``, bytes."""


def log_document(opened: Opened, shown: LogMap, *, folded: bool = True) -> dict[str, Any]:
    """JSON. Before the log is ``folded`` it names no runs and no problems."""
    corrections = shown.timeline.corrections() if folded else Corrections()
    settings = opened.settings(corrections)
    return {
        "name": shown.reader.path.name,
        "path": str(shown.reader.path),
        "log_id": shown.log_id,
        "events": shown.reader.next_offset,
        "through": shown.through if folded else 0,
        "state": shown.key if folded else "",
        "runs": _runs(shown) if folded else [],
        "settings": settings.by_name(),
        "changed_settings": settings.changed_from(Settings()),
        "fingerprint": settings.fingerprint(),
        "corrections": corrections.fingerprint(),
        "fusion": settings.fusion,
        "places_rule": settings.places,
        "places_text": settings.places_text(),
        "edits_allowed": opened.edits,
        "token_needed": opened.token_needed,
        "losses": shown.log_events.losses,
        "rejected": shown.log_events.rejected,
        "walls": _walls(shown) if folded else [],
        "maps": _maps(shown) if folded else [],
        "problems": [visible(each) for each in shown.problems] if folded else [],
    }


def memory_document() -> dict[str, Any]:
    """The peak memory of the server, and the number of maps that it keeps."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIB
    most = MOST_HISTORIES + MOST_ALTERNATIVES
    return {
        "peak_bytes": peak,
        "most_maps": most,
        "text": f"{peak / 2**20:,.0f} MiB at most so far; at most {most} maps are kept",
    }


def _walls(shown: LogMap) -> list[list[float]]:
    """The walls of the occupancy maps in force at the end of the log, of all floors."""
    last = {given.map.floor: given.map for given in shown.timeline.history.maps}
    return [segment for each in last.values() for segment in wall_segments(each)]


def _maps(shown: LogMap) -> list[dict[str, Any]]:
    """The occupancy maps that the log was given, with the floor that each names."""
    given = shown.timeline.history.maps
    return [{"offset": each.offset, "floor": each.map.floor} for each in given]


def _runs(shown: LogMap) -> list[dict[str, Any]]:
    history = shown.timeline.history
    keyframes = [0] * len(history.runs)
    first: dict[int, int] = {}
    for keyframe in history.keyframes:
        keyframes[keyframe.run] += 1
        first.setdefault(keyframe.run, keyframe.offset)
    return [
        {"run_id": seen[0].run_id, "first_offset": first[run], "keyframes": keyframes[run]}
        for run, seen in enumerate(history.runs)
    ]
