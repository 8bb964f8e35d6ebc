"""The same sites by `mapfold replay` in turn, by pools of processes, and by a Dask cluster."""

import contextlib
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from projections.adapters.fleet.engines import (
    ClusterError,
    DaskCluster,
    Ended,
    Engine,
    LocalPool,
    Progress,
)
from projections.adapters.fleet.site_databases import site_databases
from projections.adapters.fleet.site_tasks import ReplayRequest, SiteReplay, replay_site
from projections.adapters.fleet.sites import Site
from projections.postgres.embedded import EmbeddedServer
from scripts.programs.bench.projections.world import make_log

WORKERS = 2
REPLAYS, ONE = "replays", "pool of 1"


def make_sites(folder: Path, sites: int, keyframes: int) -> list[Site]:
    """Sites with logs of so many keyframes, each of another robot."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"site{number:02d}x{keyframes}" for number in range(sites)]
    return [Site(name, make_log(folder / name, keyframes, seed=i)) for i, name in enumerate(names)]


def requests_for(
    template: str, sites: Sequence[Site], *, again: bool = True
) -> list[ReplayRequest]:
    """To rebuild each site in a database of its own."""
    with site_databases(sites, template, None) as databases:
        return [ReplayRequest(site, databases[site.name], again=again) for site in sites]


def replayed(engine: Engine, requests: Sequence[ReplayRequest]) -> list[Ended]:
    """Run them; each must have been rebuilt."""
    ended = list(engine.run(replay_site, requests))
    for each in ended:
        if not isinstance(each.result, SiteReplay) or each.result.outcome == "failed":
            raise SystemExit(f"site {each.index}: {each.error or each.result.error}")
    return ended


def template_on(server: EmbeddedServer, prefix: str) -> str:
    """A template of databases on the server."""
    return server.url_of(f"{prefix}_SITE").replace("SITE", "{site}")


def compare(template: str, sites: Sequence[Site], rounds: int) -> None:
    """Print the times of each round and the medians of their ratios."""
    with dask_cluster(WORKERS) as cluster_:
        address = cluster_.address
        requests = requests_for(template, sites)
        with DaskCluster(address) as cluster:  # makes the databases, and the workers' imports
            replayed(cluster, requests)
        times: dict[str, list[float]] = {name: [] for name in (REPLAYS, ONE, "pool", "dask")}
        starts = []
        for number in range(rounds):
            order = list(times)
            for name in order[number % 4 :] + order[: number % 4]:
                times[name].append(_seconds(name, address, requests))
            starts.append(_start_seconds())
            row = ", ".join(f"{name} {times[name][-1]:.1f} s" for name in times)
            print(f"  round {number + 1}: {row}, load {os.getloadavg()[0]:.1f}", flush=True)
    replays, one, pool, dask = times.values()
    started = [whole - start for whole, start in zip(pool, starts, strict=True)]
    print(
        f"pool of {WORKERS}: {_median(replays, pool):.2f} × as fast as `mapfold replay` of one site"
        f" after another (goal 1.6), {_median(one, pool):.2f} × as fast as a pool of 1; dask takes"
        f" {_median(dask, started):.2f} × the pool's time, start-up apart (goal at most 1.3; the"
        f" pool's is {statistics.median(starts):.1f} s)"
    )


def _median(over: Sequence[float], under: Sequence[float]) -> float:
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def _seconds(name: str, address: str, requests: Sequence[ReplayRequest]) -> float:
    """Wall seconds; of the pool with the start of its processes, of the cluster without."""
    started = time.perf_counter()
    if name == REPLAYS:
        for request in requests:
            command = [
                sys.executable,
                "-m",
                "projections.surfaces.cli",
                "replay",
                str(request.site.log),
            ]
            command += ["--db", request.databases.graph_url]
            subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - started
    if name == "dask":
        with DaskCluster(address) as engine:
            started = time.perf_counter()
            replayed(engine, requests)
            return time.perf_counter() - started
    with LocalPool(1 if name == ONE else WORKERS) as pool:
        replayed(pool, requests)
    return time.perf_counter() - started


def _start_seconds() -> float:
    """How long the pool's processes take to start and to import what a replay needs."""
    started = time.perf_counter()
    with LocalPool(WORKERS) as pool:
        list(pool.run(_nothing, range(WORKERS)))
    return time.perf_counter() - started


def _nothing(_request: int, _progress: Progress) -> None:
    """A task that needs this module's imports."""


@dataclass(frozen=True, slots=True)
class RunningCluster:
    """A scheduler at ``address``, HOST:PORT."""

    address: str
    scheduler: "subprocess.Popen[bytes]"

    def kill_scheduler(self) -> None:
        """As a machine that loses its power would."""
        self.scheduler.kill()


@contextlib.contextmanager
def dask_cluster(workers: int) -> Iterator[RunningCluster]:
    """A scheduler with so many workers of one thread each; ended afterwards."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    address = f"127.0.0.1:{port}"
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        scheduler = ["--host", "127.0.0.1", "--port", port, "--no-dashboard"]
        running = stack.enter_context(_running("scheduler", scheduler))
        worker = [f"tcp://{address}", "--nthreads", "1", "--no-dashboard"]
        for _ in range(workers):
            stack.enter_context(_running("worker", [*worker, "--local-directory", folder]))
        _wait_for(address, workers)
        yield RunningCluster(address, running)


@contextlib.contextmanager
def _running(program: str, options: Sequence[str]) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{program}", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # a worker has a process of its own
            process.wait()


def _wait_for(address: str, workers: int) -> None:
    deadline = time.monotonic() + 60.0
    while True:
        try:
            with DaskCluster(address) as cluster:
                cluster.wait_for_workers(workers, 60.0)
                return
        except ClusterError:
            if time.monotonic() > deadline:
                raise
