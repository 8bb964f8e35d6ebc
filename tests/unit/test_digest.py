"""The digest's lines are JSON: those formatted by hand equal those of an encoder."""

import hashlib
import json
from typing import Any

from projections.map.digest import map_digest
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, fold


def by_encoder(view: MapView) -> str:
    """The digest again, each row through the standard library's encoder."""
    sections: dict[str, list[Any]] = {
        "runs": [(r.run_id, r.started_at) for r in view.runs],
        "keyframes": [
            (
                k.run,
                k.keyframe_id,
                k.timestamp,
                None if k.pose is None else (k.pose.x_um, k.pose.y_um, k.pose.yaw_rad),
                k.place,
            )
            for k in view.keyframes
        ],
        "observations": [
            (
                o.keyframe, o.det_id, o.class_name, o.confidence, o.bbox, o.embedding_model,
                o.embedding_crc, o.foreign_space, o.object, o.similarity_q40,
            )
            for o in view.observations
        ],
        "objects": [
            (
                o.object_id, o.class_name, o.obs_count, o.sum_x_um, o.sum_y_um, o.first_seen,
                o.last_seen, o.place,
            )
            for o in view.objects.values()
        ],
        "places": [
            (p.ordinal, p.place_id, p.founder, p.keyframe_count, p.sum_x_um, p.sum_y_um)
            for p in view.places.values()
        ],
        "adjacency": view.edges(),
    }  # fmt: skip
    text = "mapfold map 1\n"
    for name, rows in sections.items():
        text += f"{name}\n"
        text += "".join(json.dumps(row, separators=(",", ":")) + "\n" for row in rows)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def awkward() -> Folded:
    """Texts with everything JSON escapes, numbers of all sizes, no pose, a foreign vector."""
    seen = [
        detection('quo"te \\ back', [3.0, 4.0], confidence=1),
        detection("tæßt 机器 🤖 ]\u2028[", bbox=[0, -0.0, 1e300, 5e-324]),
        detection("cup", [1.0, 2.0, 3.0]),
        detection("cup", [4.0, 3.0], confidence=0.1, det_id='it\'s,"one"'),
    ]
    walk = [envelope(k, 0.3 * k, 1e-7 * k, detections=seen[: k % 5]) for k in range(1, 12)]
    walk = [{**e, "detections": [{**d} for d in e["detections"]]} for e in walk]
    for e in walk:
        for d in e["detections"]:
            if "det_id" in d:
                d["det_id"] += str(e["keyframe_id"])
    away = [
        envelope(100, 5e6, -5e6),
        envelope(101, None),
        envelope(-(2**63), 1.0, 1.0, timestamp=0.0),
    ]
    return fold([*walk, *away])


def test_lines_are_what_an_encoder_writes() -> None:
    view = awkward().view
    assert view.counts()["foreign_embeddings"] > 0
    assert {k.place for k in view.keyframes} >= {None, 0}
    assert map_digest(view) == by_encoder(view)


def test_more_lines_than_are_hashed_together() -> None:
    view = fold(envelope(k, 0.1 * k, 0.0) for k in range(1200)).view
    assert map_digest(view) == by_encoder(view)
