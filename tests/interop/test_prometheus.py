"""The metrics of a recorder, checked by Prometheus' own `promtool`."""

import shutil
import subprocess
import urllib.request
from pathlib import Path

import pytest

from eventsrc.metrics import serving_metrics
from tests.integration.test_metrics import REPORT

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
    done = subprocess.run(
        [promtool, "check", "metrics"], input=scraped, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, b"")
