"""A calibration is the same whatever instructions BLAS, numpy and libm use."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.support.commands import PROGRAM
from tests.support.seen_rooms import write_room
from tests.support.thorough import stride

KERNELS = ("Prescott", "Nehalem", "Sandybridge", "Haswell", "Zen")
WITHOUT = ("AVX512_ICL AVX512_SPR X86_V4", "AVX512_ICL AVX512_SPR X86_V4 X86_V3")
OLDER_LIBM = "glibc.cpu.hwcaps=-AVX2,-FMA"
CHOSEN = [
    {"GLIBC_TUNABLES": OLDER_LIBM},
    *({"OPENBLAS_CORETYPE": kernel} for kernel in KERNELS),
    *({"NPY_DISABLE_CPU_FEATURES": features} for features in WITHOUT),
]


@pytest.mark.slow
def test_every_kernel_gives_the_same_constants(tmp_path: Path) -> None:
    log = write_room(tmp_path / "log", count=30)
    told = {
        subprocess.run(
            [PROGRAM, "calibrate", log, "--json"],
            env={**os.environ, **chosen},
            check=True,
            capture_output=True,
        ).stdout
        for chosen in CHOSEN[:: stride(4)]
    }
    assert len(told) == 1
    document = told.pop()
    assert b"evidence.same_back" in document
    assert json.loads(document)["localiser"]["constants"]["localizer.known_count"] > 30
