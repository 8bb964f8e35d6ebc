"""The demo's numbers as one JSON document. Lengths in metres, times in seconds."""

from dataclasses import asdict
from typing import Any

from projections.runner import RebuildReport
from projections.settings import Settings

from .asking import Asked, Lost
from .folder import DemoFolder
from .mapping import Folded
from .recording import Recorded


def document(
    seed: int,
    settings: Settings,
    recorded: Recorded,
    folded: Folded,
    replayed: RebuildReport,
    lost: Lost,
    seconds: dict[str, float],
    folder: DemoFolder,
) -> dict[str, Any]:
    """What ``mapfold demo --json`` prints."""
    counts = folded.view.counts()
    return {
        "seed": seed,
        "settings": settings.model_dump(),
        "record": asdict(recorded),
        "map": {
            "keyframes": counts["keyframes"],
            "places": counts["places"],
            "objects": counts["objects"],
            "adjacent_pairs": counts["adjacency"],
            "transitions": sum(count for _, _, count in folded.view.edges()),
            "digest": folded.digest,
        },
        "merges": [asdict(merge) for merge in folded.merges],
        "replay": {
            "rows": replayed.rows,
            "digest": replayed.digest,
            "seconds": replayed.total_s,
        },
        "relocalize": _lost(lost),
        "seconds": {**seconds, "total": sum(seconds.values())},
        "files": {
            "folder": str(folder.path),
            "log": str(folder.log),
            "settings": str(folder.settings),
            "map": str(folder.map),
        },
    }


def _lost(lost: Lost) -> dict[str, Any]:
    return {
        "run_id": lost.run_id,
        "keyframe_id": lost.keyframe_id,
        "room": lost.room,
        "truth": asdict(lost.truth),
        "questions": [_asked(asked) for asked in lost.questions],
        "everywhere": asdict(lost.everywhere),
    }


def _asked(asked: Asked) -> dict[str, Any]:
    return {
        "classes": list(asked.classes),
        "error_m": asked.error_m,
        "seconds": asked.seconds,
        **asked.answer.document(),
    }
