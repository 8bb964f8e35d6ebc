"""Workers killed in the middle: all sites right, none rebuilt twice, as their databases say."""

import os
import random
import signal
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload
from projections.adapters.fleet.engines import DaskCluster, Ended, LocalPool
from projections.adapters.fleet.site_tasks import ReplayRequest, replay_site
from projections.adapters.fleet.sites import Site
from projections.fold.settings import Settings
from projections.postgres.check import check
from projections.postgres.connection import connect
from scripts.programs.bench.projections.world import KEY, World

from .speed import WORKERS, dask_cluster, replayed, requests_for

_AUDIT = """
CREATE TABLE IF NOT EXISTS public.audit (sink text);
TRUNCATE public.audit;
CREATE OR REPLACE FUNCTION public.audit() RETURNS trigger LANGUAGE plpgsql AS
  $$ BEGIN INSERT INTO public.audit VALUES (NEW.sink); RETURN NEW; END $$;
CREATE OR REPLACE TRIGGER audit AFTER INSERT OR UPDATE OF next_offset ON mapfold.checkpoint
  FOR EACH ROW EXECUTE FUNCTION public.audit();
"""


@dataclass(frozen=True, slots=True)
class Killed:
    """The outcome of a run: workers killed, starts of sites (0 if unknown), and sites whose
    checkpoint was moved more than once."""

    workers: int
    begun: int
    twice: int


def kill_workers(template: str, sites: Sequence[Site], kills: int = 4) -> None:
    """Print what comes of killed workers; exits if a site is wrong."""
    for name in ("pool", "dask"):
        found = killed(template, sites, name, kills)
        begun = f" in {found.begun} attempts" if found.begun else ""
        print(
            f"{name}: {found.workers} workers killed while {len(sites)} sites were rebuilt{begun}:"
            f" all equal to their logs, {found.twice} rebuilt twice",
            flush=True,
        )


def killed(template: str, sites: Sequence[Site], name: str, kills: int, every: int = 6) -> Killed:
    """Rebuild all sites after each has another event, and kill workers of the pool or of a cluster
    meanwhile, one at every so many reports of progress. Raises AssertionError if a site is not
    equal to its log then."""
    requests = requests_for(template, sites, again=False)
    with LocalPool(WORKERS) as pool:
        replayed(pool, requests)
    for request in requests:
        _grow(request.site.log)
        with connect(request.databases.graph_url, autocommit=True) as connection:
            connection.execute(_AUDIT)
    killer = _Killer(kills, every)
    if name == "pool":
        with LocalPool(WORKERS) as pool:
            ended = _checked(pool.run(replay_site, requests, killer), len(requests))
        return Killed(killer.done, sum(each.attempts for each in ended), _judge(requests))
    with dask_cluster(WORKERS) as running, DaskCluster(running.address) as cluster:
        _checked(cluster.run(replay_site, requests, killer), len(requests))
    return Killed(killer.done, 0, _judge(requests))


def _grow(log: Path) -> None:
    with LogWriter(log, fsync=NEVER) as writer:
        keyframe = writer.next_offset
        world = World(int(keyframe))
        append_payload(writer, KEY, world.payload(int(keyframe)))


def _checked(ended: Iterator[Ended], sites: int) -> list[Ended]:
    found = list(ended)
    for each in found:
        if each.result is None or each.result.outcome == "failed":
            raise AssertionError(f"site {each.index}: {each.error or each.result.error}")
    if sorted(each.index for each in found) != list(range(sites)):
        raise AssertionError("a site has no result, or two")
    return found


class _Killer:
    """Called several times a second while sites are rebuilt; kills a worker at every n-th call."""

    def __init__(self, kills: int, every: int) -> None:
        self._kills, self._every = kills, every
        self.done = self._calls = 0
        self._chance = random.Random(7)

    def __call__(self, _events: int) -> None:
        self._calls += 1
        if self.done < self._kills and self._calls % self._every == 0:
            workers = _workers_under(os.getpid())
            if workers:
                os.kill(self._chance.choice(workers), signal.SIGKILL)
                self.done += 1


def _workers_under(parent: int) -> list[int]:
    """Those that this process runs calls in, or that multiprocessing has spawned for Dask."""
    return [pid for pid, args in processes_under(parent).items() if is_worker(args)]


def is_worker(arguments: str) -> bool:
    """Whether a command line is that of a pool's worker, or of one of Dask's."""
    return "worker_process:_make_calls" in arguments or "spawn_main" in arguments


def processes_under(parent: int) -> dict[int, str]:
    """The command lines of a process's children, their children and so on, by process id."""
    listed = subprocess.run(
        ["ps", "-wweo", "pid=,ppid=,args="], capture_output=True, text=True, check=True
    )
    rows = [line.split(maxsplit=2) for line in listed.stdout.splitlines()]
    under = {parent}
    while True:
        more = under | {int(pid) for pid, above, _ in rows if int(above) in under}
        if more == under:
            break
        under = more
    return {int(pid): args for pid, _, args in rows if int(pid) in under - {parent}}


def _judge(requests: Sequence[ReplayRequest]) -> int:
    """How many sites were rebuilt twice; raises if one's rows are not those of its log."""
    twice = 0
    for request in requests:
        reports = check(request.site.log, request.databases, Settings())
        if not all(report.sound for report in reports):
            raise AssertionError(f"{request.site.name}: {[report.differing for report in reports]}")
        with connect(request.databases.graph_url) as connection:
            rows = connection.execute(
                "SELECT sink, count(*) FROM public.audit GROUP BY sink ORDER BY sink"
            ).fetchall()
        if [sink for sink, _ in rows] != ["graph", "vectors"]:
            raise AssertionError(f"{request.site.name}: rebuilt were {rows}")
        twice += any(count != 1 for _, count in rows)
    return twice
