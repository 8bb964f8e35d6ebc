"""One log, one digest: on every BLAS kernel, thread count and hash seed, in processes of their own.

OpenBLAS picks a kernel by ``OPENBLAS_CORETYPE``. That the kernels differ is checked too: a plain
float32 product has more than one result among them, or this test would prove nothing here.
"""

import os
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.support.envelopes import detection, envelope, payload
from tests.support.shared_data import shared_run
from tests.support.thorough import mostly_slow, rounds, stride

KERNELS = ("Prescott", "Nehalem", "Haswell", "SkylakeX", "Zen")
PLACES = [(kernel, "1", "0") for kernel in KERNELS] + [
    ("Haswell", "2", "1"),
    ("Prescott", "2", "12345"),
    ("Nehalem", "2", "random"),
]

FOLD = """
import hashlib, sys
from pathlib import Path
import numpy as np
from eventsrc.envelope.ingest import ingest
from eventsrc.log import Event
from projections.map.digest import map_digest
from projections.map.fold import fold_events
from projections.map.parsing import READ_AHEAD
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.view import MapView
from tests.support.thorough import stride

settings = Settings(eps_m=0.75, min_samples=8, fusion=sys.argv[2], places=sys.argv[3])
fold, view, vectors = SemanticMap(settings), MapView(settings), []
lines = Path(sys.argv[1]).read_bytes().splitlines()
for offset, line in enumerate(lines):
    accepted = ingest(line)
    vectors += [vector for vector in accepted.vectors if vector is not None]
    view.apply_event(offset, fold.fold(offset, accepted))
ahead = MapView(settings)
events = (Event(offset, "tb/detections", 0, 0, line) for offset, line in enumerate(lines))
for folded in fold_events(events, SemanticMap(settings), ahead=READ_AHEAD):
    ahead.apply_event(folded.offset, folded.deltas)
assert map_digest(ahead) == map_digest(view)
matrix = np.array(vectors[:200])
print(map_digest(view), hashlib.sha256((matrix @ matrix[0]).tobytes()).hexdigest())
"""


def _synthetic_run() -> list[bytes]:
    """A walk along a wavy corridor; looks scatter around eight things' directions, and some
    detections have none."""
    rng = np.random.default_rng(4)
    looks = rng.normal(size=(8, 512))
    payloads = []
    for i in range(rounds(300, 120)):
        which = [int(w) for w in rng.choice(8, 2, replace=False)]
        seen = [
            detection(f"class {w % 3}", None if w + i % 3 == 5 else look, det_id=f"{i}-{w}")
            for w, look in zip(which, looks[which] + rng.normal(size=(2, 512)) * 0.8, strict=True)
        ]
        x, y = i * 0.21 % 12, float(np.sin(i / 7))
        payloads.append(payload(envelope(i, x, y, detections=seen)))
    return payloads


def _fold_in(kernel: str, threads: str, seed: str, lines: Path, *rules: str) -> tuple[str, str]:
    env = os.environ | {
        "OPENBLAS_CORETYPE": kernel,
        "OPENBLAS_NUM_THREADS": threads,
        "PYTHONHASHSEED": seed,
    }
    done = subprocess.run(
        [sys.executable, "-c", FOLD, str(lines), *rules],
        env=env,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    digest, product = done.stdout.split()
    return digest, product


@pytest.mark.parametrize(
    ("run", "rules"),
    mostly_slow(
        product(
            ["synthetic", "house-a", "home-1"],
            [("page", "page"), ("evidence", "page"), ("page", "rooms")],
        ),
    ),
)
def test_one_digest_on_every_kernel_thread_count_and_hash_seed(
    run: str, rules: tuple[str, str], tmp_path: Path
) -> None:
    payloads = _synthetic_run() if run == "synthetic" else shared_run(run)
    lines = tmp_path / "run.jsonl"
    lines.write_bytes(b"\n".join(payloads))
    chosen = PLACES[:: stride(5)]
    results = {place: _fold_in(*place, lines, *rules) for place in chosen}
    assert len({digest for digest, _ in results.values()}) == 1, results
    assert len({product for _, product in results.values()}) > 1, "all kernels are one here"
