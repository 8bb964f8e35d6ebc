"""Workers of a fleet's engines killed in the middle: every site right, none rebuilt twice."""

from pathlib import Path

import pytest

from projections.adapters.fleet.engines import RETRIES, ClusterError, DaskCluster
from projections.adapters.fleet.site_tasks import ReplayRequest, replay_site
from projections.adapters.fleet.sites import Site
from projections.postgres.connection import Targets
from projections.postgres.embedded import EmbeddedServer
from scripts.programs.bench.fleet.killing import killed
from scripts.programs.bench.fleet.speed import dask_cluster, make_sites
from tests.support.envelopes import envelope
from tests.support.fleet_tasks import wait
from tests.support.fleets import fleet_databases
from tests.support.logs import write_log


def test_a_request_that_is_begun_again_finds_its_site_done(pg_url: str, tmp_path: Path) -> None:
    """What a second worker does with a site whose first one was killed after it committed."""
    log = write_log(tmp_path / "log", [envelope(0, 0.0, 0.0)])
    request = ReplayRequest(Site("a", log), Targets(pg_url, pg_url))
    assert [replay_site(request, print).outcome for _ in range(2)] == ["rebuilt", "up_to_date"]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pool", "dask"])
def test_every_site_is_right_and_none_done_twice(
    engine: str, pg_server: EmbeddedServer, tmp_path: Path
) -> None:
    with fleet_databases(pg_server) as template:
        sites = make_sites(tmp_path / "sites", 6, 300)
        found = killed(template, sites, engine, kills=RETRIES, every=3)
    assert 1 <= found.workers <= RETRIES
    assert found.twice == 0


@pytest.mark.slow
def test_a_scheduler_that_goes_is_an_error_after_a_while(tmp_path: Path) -> None:
    gone: list[str] = []
    requests = [tmp_path / "a", tmp_path / "b"]
    for path in requests:
        path.mkdir()
    with dask_cluster(1) as cluster, DaskCluster(cluster.address) as engine:

        def kill_scheduler(_events: int) -> None:
            if not gone and any((path / "pid").exists() for path in requests):
                cluster.kill_scheduler()
                gone.append("scheduler")

        with pytest.raises(ClusterError, match="the scheduler has ended; of 2 of 2 sites"):
            list(engine.run(wait, requests, kill_scheduler))
