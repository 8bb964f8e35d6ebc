"""A calibration is the same under every BLAS kernel."""

import os
import subprocess
from pathlib import Path

from tests.commands import PROGRAM
from tests.seen_rooms import write_room

KERNELS = ("Prescott", "Nehalem", "Sandybridge", "Haswell", "Zen")


def test_every_kernel_gives_the_same_constants(tmp_path: Path) -> None:
    log = write_room(tmp_path / "log", count=30)
    told = {
        subprocess.run(
            [PROGRAM, "calibrate", log, "--json"],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
            check=True,
            capture_output=True,
        ).stdout
        for kernel in KERNELS
    }
    assert len(told) == 1
    assert b"evidence.same_back" in told.pop()
