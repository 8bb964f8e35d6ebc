"""A whole simulated run: valid, repeatable, with faults like a detector's and the truth apart."""

import gzip
import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from eventsrc.adapters.sim import SimulatedRun, simulate_run
from eventsrc.adapters.sim.detector import DIM
from eventsrc.adapters.sim.simulation import truth_path, write_run
from eventsrc.base.errors import MisuseError
from eventsrc.envelope.ingest import Accepted, ingest
from tests.support.logs import simulated
from tests.support.thorough import stride

WITNESS_SHA256 = "18dcb69627ea4b825aeeb605d019fea0b9e27f75a73a4b8415640b76f72758a1"
"""Of run a of house 7, its payloads joined by line ends. It moves only when the simulator does."""


def _run(name: str) -> SimulatedRun:
    return simulated(7, name)


def _vectors(payload: bytes) -> tuple[NDArray[np.float32] | None, ...]:
    accepted = ingest(payload)
    assert isinstance(accepted, Accepted), accepted
    return accepted.vectors


@cache
def _crops() -> tuple[NDArray[np.float32], list[str], list[str]]:
    """Every true detection of three sessions: unit vectors, instances, classes."""
    vectors: list[NDArray[np.float32]] = []
    instances: list[str] = []
    for run in map(_run, "abc"):
        for payload, truth in zip(run.payloads, run.truth, strict=True):
            for vector, instance in zip(_vectors(payload), truth["instances"], strict=True):
                if instance is not None and vector is not None:
                    vectors.append(vector / np.linalg.norm(vector))
                    instances.append(instance)
    class_of = {t.instance: t.model.class_name for t in _run("a").house.things}
    return np.array(vectors), instances, [class_of[instance] for instance in instances]


@pytest.mark.seconds
def test_every_payload_is_an_envelope() -> None:
    for run in map(_run, "abc"[:: stride(3)]):
        assert all(isinstance(ingest(payload), Accepted) for payload in run.payloads)
        assert [e["keyframe_id"] for e in run.envelopes] == list(range(1, len(run.envelopes) + 1))


@pytest.mark.seconds
def test_the_seed_makes_the_run_byte_for_byte() -> None:
    digest = hashlib.sha256(b"\n".join(simulate_run(7, "a").payloads)).hexdigest()
    assert digest == hashlib.sha256(b"\n".join(_run("a").payloads)).hexdigest()
    assert digest == WITNESS_SHA256


def test_runs_differ_in_session_and_tour() -> None:
    assert _run("a").run_id != _run("b").run_id
    assert _run("a").house.things == _run("b").house.things
    assert _run("b").envelopes[0]["timestamp"] > _run("a").envelopes[-1]["timestamp"]


@pytest.mark.parametrize(
    ("which", "low", "high"),
    [
        ("same instance", 0.82, 0.92),
        ("same class, another instance", 0.66, 0.82),
        ("another class", 0.48, 0.58),
    ],
)
def test_cosines_come_out_as_on_real_crops(which: str, low: float, high: float) -> None:
    vectors, instances, classes = _crops()
    instance_of, class_of = np.array(instances), np.array(classes)
    same_instance = instance_of[:, None] == instance_of[None, :]
    same_class = class_of[:, None] == class_of[None, :]
    wanted = {
        "same instance": same_instance,
        "same class, another instance": same_class & ~same_instance,
        "another class": ~same_class,
    }[which]
    pairs = np.triu_indices(len(vectors), 1)
    cosines = (vectors @ vectors.T)[pairs][wanted[pairs]]
    assert len(cosines) > 10_000
    assert np.percentile(cosines, 5) == pytest.approx(low, abs=0.015)
    assert np.percentile(cosines, 95) == pytest.approx(high, abs=0.015)


@pytest.mark.seconds
@pytest.mark.slow
def test_another_house_has_other_things_of_the_same_models() -> None:
    there = simulate_run(8, "a")
    assert not {t.instance for t in there.house.things} & {
        t.instance for t in _run("a").house.things
    }
    vectors, instances, _ = _crops()
    elsewhere = [
        vector / np.linalg.norm(vector)
        for payload, truth in zip(there.payloads, there.truth, strict=True)
        for vector, instance in zip(_vectors(payload), truth["instances"], strict=True)
        if instance is not None and vector is not None
    ]
    nearest = (np.array(elsewhere) @ vectors.T).max(axis=1)
    again = [i for i, instance in enumerate(instances) if instances.index(instance) != i]
    own = vectors[again] @ vectors.T
    own[np.array(instances)[again][:, None] != np.array(instances)] = -1.0
    own[own > 0.999] = -1.0  # the very crop
    assert np.median(nearest) < np.percentile(own.max(axis=1), 5)


def test_embeddings_are_unit_vectors_in_half_precision() -> None:
    accepted = ingest(next(p for p in _run("a").payloads if b"embedding" in p))
    assert isinstance(accepted, Accepted)
    vector = accepted.vectors[0]
    assert vector is not None
    assert vector.shape == (DIM,)
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-3)
    assert (vector == vector.astype(np.float16).astype(np.float32)).all()


def test_some_labels_are_wrong_and_some_detections_are_of_nothing() -> None:
    class_of = {t.instance: t.model.class_name for t in _run("a").house.things}
    labels = [
        (detection["class"], instance)
        for run in map(_run, "abc")
        for envelope, truth in zip(run.envelopes, run.truth, strict=True)
        for detection, instance in zip(envelope["detections"], truth["instances"], strict=True)
    ]
    wrong = sum(instance is not None and class_of[instance] != name for name, instance in labels)
    phantoms = sum(instance is None for _, instance in labels)
    keyframes = sum(len(run.envelopes) for run in map(_run, "abc"))
    assert 0.02 < wrong / len(labels) < 0.07
    assert 0.008 < phantoms / keyframes < 0.04


def test_the_truth_is_parallel_to_the_envelopes_and_in_no_payload() -> None:
    run = _run("a")
    for envelope, truth in zip(run.envelopes, run.truth, strict=True):
        assert set(truth) == {"run_id", "keyframe_id", "room", "instances"}
        assert (truth["run_id"], truth["keyframe_id"]) == (run.run_id, envelope["keyframe_id"])
    everything = b"".join(run.payloads)
    names = {t.instance for t in run.house.things} | {"living room", "bathroom", "hall"}
    assert not any(name.encode() in everything for name in names)


def test_poses_are_those_of_a_localisation_near_the_true_ones() -> None:
    run = _run("a")
    off = [
        np.hypot(envelope["map_x"] - pose.x, envelope["map_y"] - pose.y)
        for envelope, pose in zip(run.envelopes, run.true_poses, strict=True)
    ]
    assert 0.005 < float(np.mean(off)) < 0.03
    assert float(np.max(off)) < 0.08


@pytest.mark.parametrize("name", ["run.jsonl", "run.jsonl.gz"])
def test_a_written_run_reads_back_and_has_its_truth_beside_it(tmp_path: Path, name: str) -> None:
    run, out = _run("b"), tmp_path / "new" / name
    truth = write_run(run, out)
    assert truth == truth_path(out)
    assert truth.parent == out.parent
    read = gzip.decompress if name.endswith(".gz") else bytes
    assert read(out.read_bytes()).splitlines() == list(run.payloads)
    assert [json.loads(line) for line in read(truth.read_bytes()).splitlines()] == list(run.truth)
    written = out.read_bytes()
    write_run(run, out)
    assert out.read_bytes() == written


def test_a_file_of_other_bytes_is_not_replaced(tmp_path: Path) -> None:
    run, out = simulated(run="b"), tmp_path / "run.jsonl"
    truth = write_run(run, out)
    written = out.read_bytes(), truth.read_bytes()
    write_run(run, out)  # the same once more
    truth.write_bytes(b"mine")
    out.unlink()
    with pytest.raises(MisuseError, match=r"run\.truth\.jsonl: there is another file of this name"):
        write_run(run, out)
    assert not out.exists()
    assert truth.read_bytes() == b"mine"
    truth.unlink()
    write_run(run, out)
    assert (out.read_bytes(), truth.read_bytes()) == written
