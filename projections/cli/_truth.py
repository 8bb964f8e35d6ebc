"""Scores against a truth that says nothing of the map look perfect; people are told so."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eventsrc.cli._shell import say


def warn_of_no_truth(log: Path, scores: Mapping[str, Any] | None) -> None:
    """Say so when none of a map's keyframes and observations has truth; None is no scores."""
    if scores is None or scores["places"]["rooms"] or scores["objects"]["instances"]:
        return
    say(f"no truth for any keyframe of {log}: its places and objects are not scored; see --truth")
