"""The metrics of a recorder and of a service, checked by Prometheus' own `promtool`."""

import shutil
import subprocess
import urllib.request
from pathlib import Path

import pytest

from eventsrc.record.metrics import serving_metrics
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from tests.integration.test_metrics import REPORT
from tests.support.services import build

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def promtool(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The installed one, else that of Debian's package, unpacked but not installed."""
    found = shutil.which("promtool")
    if found:
        return found
    if not shutil.which("apt-get") or not shutil.which("dpkg"):
        pytest.skip("promtool is not installed, and there is no apt-get to fetch it with")
    folder = tmp_path_factory.mktemp("prometheus")
    subprocess.run(["apt-get", "download", "--quiet", "prometheus"], cwd=folder, check=True)
    (package,) = folder.glob("*.deb")
    subprocess.run(["dpkg", "-x", package, folder / "unpacked"], check=True)
    return str(folder / "unpacked" / "usr" / "bin" / "promtool")


def test_metrics_of_a_recorder(promtool: str, tmp_path: Path) -> None:
    with (
        serving_metrics(("127.0.0.1", 0), lambda: REPORT, tmp_path) as port,
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as response,
    ):
        scraped = response.read()
    assert b"mapfold_recorder_recorded_total 12" in scraped
    check(promtool, scraped)


def test_metrics_of_a_service(promtool: str, one_database: Targets, tmp_path: Path) -> None:
    build(tmp_path, one_database)
    with Pools(one_database, 1) as pools, FairQueue(1, max_wait_s=30.0) as queue:
        answerer = Answerer(pools, per_second=1000.0)
        app = create_app(answerer, queue)
        with serving(app, bind("127.0.0.1", 0)) as port:
            for path in ("state/objects", "state/places?x=0&y=0", "health"):
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}") as response:
                    assert response.read()
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as response:
                scraped = response.read()
    assert scraped.count(b'result="answered"') == 3
    check(promtool, scraped)


def check(promtool: str, scraped: bytes) -> None:
    """Fail unless promtool has nothing to say of the metrics."""
    done = subprocess.run(
        [promtool, "check", "metrics"], input=scraped, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, b"")
