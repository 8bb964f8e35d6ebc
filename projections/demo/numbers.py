"""The demo's numbers as one JSON document. Lengths in metres, times in seconds."""

from dataclasses import asdict, dataclass
from typing import Any

from projections.runner import RebuildReport
from projections.settings import Settings

from .asking import Asked, Lost
from .folder import DemoFolder
from .following import Followed
from .mapping import Folded
from .recording import Recorded


@dataclass(frozen=True, slots=True)
class Played:
    """What the stages brought. ``same_rows``: the replay wrote the rows that the tail had."""

    seed: int
    settings: Settings
    recorded: Recorded
    followed: Followed
    replayed: RebuildReport
    same_rows: bool
    folded: Folded
    lost: Lost

    @property
    def sound(self) -> bool:
        """Whether all that must be equal is: log and run, tail and replay, databases and fold."""
        recorded = self.recorded
        whole = recorded.intact and not recorded.rejected and not recorded.lost
        return whole and self.same_rows and self.replayed.digest == self.folded.digest


def document(played: Played, seconds: dict[str, float], folder: DemoFolder) -> dict[str, Any]:
    """What ``mapfold demo --json`` prints; ``seconds`` by stage."""
    view, replayed = played.folded.view, played.replayed
    counts = view.counts()
    return {
        "sound": played.sound,
        "seed": played.seed,
        "settings": played.settings.model_dump(),
        "record": asdict(played.recorded),
        "tail": asdict(played.followed),
        "replay": {
            "rows": replayed.rows,
            "same_rows_as_tail": played.same_rows,
            "digest": replayed.digest,
            "seconds": replayed.total_s,
        },
        "map": {
            "keyframes": counts["keyframes"],
            "places": counts["places"],
            "objects": counts["objects"],
            "adjacent_pairs": counts["adjacency"],
            "transitions": sum(count for _, _, count in view.edges()),
            "digest": played.folded.digest,
            "fold_seconds": played.folded.seconds,
        },
        "merges": [asdict(merge) for merge in played.folded.merges],
        "relocalize": _lost(played.lost),
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
