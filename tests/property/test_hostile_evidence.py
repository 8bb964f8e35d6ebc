"""Fusion by evidence of envelopes that no camera could have made: it goes on, with sane numbers."""

import json
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.envelope.commands import SameObject
from eventsrc.envelope.ingest import Rejected, ingest
from eventsrc.envelope.model import Offset
from projections.fold.corrections import NO_CORRECTIONS, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.fold.sights import MOST_OF_A_PICTURE
from projections.fold.spots import Spots
from projections.fold.things import FusedThing
from projections.map.digest import map_digest
from projections.map.state_output import state_document
from tests.support.envelopes import detection, envelope, payload
from tests.support.folds import Folded, resumed, state_bytes
from tests.support.thorough import examples

EVIDENCE = Settings(fusion="evidence", eps_m=1.0)
_ODD = (0.0, -0.0, 1e308, -1e308, 5e-324, 1e-300, 1e6, -1e6, 1e9, -50.0, 320.0, 200.0, 639.9999)
_FAR = 1e7


def hostile_drive(seed: int) -> list[dict[str, Any]]:
    """Keyframes with odd boxes, cameras, headings, depths and positions, near each other."""
    rng = random.Random(seed)
    dim, base, oddity = rng.choice([1, 2, 6]), rng.choice([0.0, _FAR, -_FAR, 5e6]), rng.random()
    looks = [[rng.gauss(0, 1) for _ in range(dim)] for _ in range(4)]

    def within(value: float) -> float:
        return max(-_FAR, min(_FAR, value))

    def box() -> list[float]:
        if rng.random() < oddity:
            return [rng.choice([*_ODD, rng.uniform(0, 640)]) for _ in range(4)]
        x, y, half = rng.uniform(0, 640), rng.uniform(0, 400), rng.uniform(0, 80)
        return [x - half, y - half, x + half, y + half]

    documents = []
    for number in range(rng.randint(5, 60)):
        x = within(base + rng.choice([0, 0, 0.1, 1, 3, rng.uniform(-4, 4)]))
        y = within(base + rng.choice([0, 0, 0.1, 1, rng.uniform(-4, 4)]))
        seen = []
        for _ in range(rng.randint(0, 5)):
            scale = rng.choice([1.0, -1.0, 1e-30, 1e18])
            look = [(value + rng.gauss(0, 0.1)) * scale for value in rng.choice(looks)]
            fields: dict[str, Any] = {}
            if rng.random() < 0.3:
                fields["depth_m"] = rng.choice([5e-324, 0.3, 1000.0, rng.uniform(0.1, 8)])
                fields["depth_sigma_m"] = rng.choice([0.001, 0.1, 1000.0])
            if rng.random() < 0.3:
                there = rng.choice([x, x + rng.uniform(-3, 3), _FAR, -_FAR, 0.0])
                fields["position"] = [within(there), within(y + rng.choice([0.0, 1.0, -_FAR]))]
                fields["position_sigma_m"] = rng.choice([0.001, 0.1, 1000.0])
            label = rng.choice(["a", "b", str(rng.random())])
            seen.append(detection(label, look, bbox=box(), **fields))
        more: dict[str, Any] = {"map_yaw": rng.choice([0.0, rng.uniform(-7, 7), 1e300, -1e18, 1e6])}
        if rng.random() < 0.3:
            more["camera"] = {
                "hfov_deg": rng.choice([1.0, 69.0, 170.0]),
                "width_px": rng.choice([1.0, 640.0, 1e6]),
                "height_px": rng.choice([1.0, 400.0, 1e6]),
                "yaw_rad": rng.choice([0.0, 7.0, -7.0]),
            }
        run = "r1" if number < 20 or rng.random() < 0.2 else "r2"
        documents.append(envelope(number, x, y, run_id=run, detections=seen, **more))
    return documents


@settings(deadline=None, max_examples=examples(60))
@given(seed=st.integers(0, 2**32), is_commanded=st.booleans())
def test_estimates_of_anything_are_finite_and_kept_folds_go_on(
    seed: int, is_commanded: bool
) -> None:
    documents = hostile_drive(seed)
    corrections = NO_CORRECTIONS
    named = [
        f"{e['run_id']}_kf{e['keyframe_id']}_d{i}"
        for e in documents
        for i, _ in enumerate(e["detections"])
    ]
    if is_commanded and len(named) > 8:  # makes one of things that stand anywhere
        pairs = [tuple(random.Random(seed + n).sample(named, 2)) for n in range(4)]
        corrections = compile_corrections(
            RecordedCommand(Offset(n), SameObject(command_id=f"c{n}", issued_by="a@b", det_ids=ids))
            for n, ids in enumerate(pairs)
        )
    cut = len(documents) // 2
    whole = Folded.start(EVIDENCE, corrections=corrections).extend(documents[:cut])
    again = resumed(whole)
    whole.extend(documents[cut:])
    for found in whole.view.objects.values():
        at = found.estimate
        assert at is not None
        assert at.var_xx_um2 > 0
        assert at.var_yy_um2 > 0
        assert at.var_xx_um2 * at.var_yy_um2 >= at.var_xy_um2**2
        assert max(abs(at.x_um), abs(at.y_um)) < 2 * _FAR * 1e6
        assert max(at.var_xx_um2, at.var_yy_um2) < 2**63
    json.dumps(state_document(whole.view, ""), allow_nan=False)
    again.extend(documents[cut:])
    assert map_digest(again.view) == map_digest(whole.view)
    assert state_bytes(again) == state_bytes(whole)


@pytest.mark.slow
def test_of_very_many_detections_in_a_picture_the_first_fuse() -> None:
    chance = np.random.default_rng(1)
    boxes = chance.uniform(20, 600, 2000).tolist()
    seen = [
        detection("cup", look.tolist(), bbox=[at, 100.0, at + 20.0, 300.0])
        for at, look in zip(boxes, chance.normal(size=(2000, 4)), strict=True)
    ]
    folded = Folded.start(EVIDENCE).extend([envelope(n, detections=seen) for n in range(2)])
    for number, observation in enumerate(folded.view.observations):
        assert (observation.object is None) == (number % 2000 >= MOST_OF_A_PICTURE), number
    assert len(folded.view.observations) == 4000
    met = folded.map.dump()["landmarks.landmarks.things.met"]
    assert sum(map(len, met)) <= 2 * MOST_OF_A_PICTURE**2


def test_a_position_out_of_the_range_of_a_depth_is_not_used() -> None:
    def estimate(**fields: Any) -> Any:
        seen = [detection("cup", [1.0, 0.5], **fields)]
        folded = Folded.start(EVIDENCE).extend([envelope(1, detections=seen)])
        (found,) = folded.view.objects.values()
        return found.estimate

    plain = estimate()
    assert estimate(position=[1000.5, 0.0], position_sigma_m=0.01) == plain
    used = estimate(position=[999.5, 0.0], position_sigma_m=0.01)
    assert used.x_um == pytest.approx(999_500_000, abs=1000)


@pytest.mark.parametrize("name", ["width_px", "height_px"])
def test_a_picture_is_at_least_one_pixel_wide_and_high(name: str) -> None:
    camera = {"hfov_deg": 90.0, "width_px": 1.0, "height_px": 1.0}
    assert not isinstance(ingest(payload(envelope(camera=camera))), Rejected)
    refused = ingest(payload(envelope(camera=camera | {name: 0.99})))
    assert isinstance(refused, Rejected)
    assert name in refused.reason


@given(labels=st.lists(st.sampled_from("abcde"), min_size=1, max_size=60))
def test_counting_a_label_gives_the_class_that_a_look_at_all_classes_gives(
    labels: list[str],
) -> None:
    thing = FusedThing(1, 0, 0, 0.0, 0.0, labels[0], {labels[0]: 1}, Spots())
    for end, label in enumerate(labels[1:], 2):
        thing.count_label(label)
        first = sorted(set(labels[:end]), key=labels.index)
        assert thing.class_name == max(first, key=labels[:end].count)
        assert thing.classes == {name: labels[:end].count(name) for name in first}
