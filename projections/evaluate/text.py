"""The scores as a table for people."""

from collections.abc import Mapping
from typing import Any

_ROWS = (
    ("questions", "questions"),
    ("known", "… of things in the map"),
    ("top1_room", "first place is the room"),
    ("top3_room", "… one of three is"),
    ("top1_contains_room", "first place contains it"),
    ("nearest_place", "first place is the nearest"),
    ("room_at_pose", "pose lies in the room"),
    ("pose_room", "nearest mapped pose does"),
    ("room_ceiling", "… could: room was mapped"),
    ("pose_error_m.p50", "pose error p50, m"),
    ("pose_error_m.p90", "pose error p90, m"),
    ("yaw_error_rad.p50", "yaw error p50, rad"),
    ("centroid_error_m.p50", "place's centroid p50, m"),
    ("centroid_error_m.p90", "place's centroid p90, m"),
    ("within_1_5_m", "pose within 1.5 m"),
    ("known_called_unknown", "known called unknown"),
    ("unknown_called_unknown", "unknown called unknown"),
    ("auroc", "AUROC known / unknown"),
    ("ece", "calibration error"),
    ("latency_ms.p50", "latency p50, ms"),
    ("latency_ms.p99", "latency p99, ms"),
)


def scores_text(scores: Mapping[str, Any]) -> str:
    """Places, objects, then re-localisation by number of crops."""
    lines = [_of("places", scores["places"]), _of("objects", scores["objects"]), ""]
    by_crops = scores["relocalization"]
    heads = [f"{n} crop{'s' if n != '1' else ''}" for n in by_crops]
    lines.append(f"re-localisation ({scores['method']})".ljust(28) + _row(heads))
    for path, label in _ROWS:
        values = [_text(_at(column, path)) for column in by_crops.values()]
        lines.append("  " + label.ljust(26) + _row(values))
    return "\n".join(lines) + "\n"


def _of(title: str, scores: Mapping[str, Any]) -> str:
    return f"{title}: " + ", ".join(f"{k} {_text(v)}" for k, v in scores.items())


def _row(cells: list[str]) -> str:
    return "".join(cell.rjust(10) for cell in cells)


def _at(column: Mapping[str, Any], path: str) -> Any:
    value: Any = column
    for part in path.split("."):
        value = value[part]
    return value


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
