"""`schemathesis` finds nothing in the HTTP interface of `mapfold serve`.

It reads /openapi.json, sends what that allows and what it forbids, and checks every response with
all the checks it has."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from eventsrc.envelope.crops import CROPS_TOPIC, Crop, encode_crop
from eventsrc.envelope.model import DetId
from eventsrc.log import LogWriter
from eventsrc.record.append import CROP_FORMAT
from projections.postgres.connection import Targets
from tests.support.http_attacks import served
from tests.support.services import MODEL, build

pytestmark = pytest.mark.slow

TOKEN = "0123456789abcdef-not-a-secret"
PROGRAM = Path(sys.executable).with_name("schemathesis")
OPERATIONS = 11
ARGS = ("--no-zenoh", "--http", "127.0.0.1:0", "--rate", "100000")


def found(port: int, folder: Path, *options: str) -> str:
    """The report of a run with all checks that found nothing."""
    if not PROGRAM.exists():
        pytest.skip("schemathesis is not installed; pip install --group interop")
    done = subprocess.run(
        [
            *(PROGRAM, "run", f"http://127.0.0.1:{port}/openapi.json", "--checks", "all"),
            *("--no-color", "--continue-on-failure", "--generation-database", "none", *options),
        ],
        cwd=folder,
        env={
            **os.environ,
            "PYTHONPATH": str(Path(__file__).parent),
            "SCHEMATHESIS_HOOKS": "schemathesis_hooks",
            "MAPFOLD_EMBEDDING_MODEL": MODEL,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"Selected: {OPERATIONS}/{OPERATIONS}" in done.stdout
    assert f"Tested: {OPERATIONS}" in done.stdout
    assert "No issues found" in done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Path:
    log = build(tmp_path_factory.mktemp("described"), module_database)
    crop = encode_crop(Crop(DetId("shown"), b"\xff\xd8\xff\xd9"), 0)
    with LogWriter(log) as writer:
        writer.append(CROPS_TOPIC, crop, form=CROP_FORMAT)
    return log


@pytest.mark.timeout(900)
def test_all_checks_of_all_phases(log: Path, module_database: Targets, tmp_path: Path) -> None:
    with served(*ARGS, "--log", str(log), "--db", module_database.graph_url) as service:
        said = found(service.port, tmp_path, "--seed", "1", "-n", "150")
    for phase in ("Examples", "Coverage", "Fuzzing"):
        assert f"✅ {phase}" in said


@pytest.mark.timeout(900)
def test_with_a_token(log: Path, module_database: Targets, tmp_path: Path) -> None:
    with served(
        *ARGS, "--log", str(log), "--db", module_database.graph_url, MAPFOLD_TOKEN=TOKEN
    ) as service:
        bearer = f"Authorization: Bearer {TOKEN}"
        found(service.port, tmp_path, "--seed", "3", "-n", "20", "-H", bearer)
