"""Drive robots of several sites through real routers and recorders, and count what was lost.

    scripts/simulate_fleet [--sites N] [--robots N] [--rate HZ] [--seconds S] [--kill] …

Every site has a router, a recorder (`mapfold record`) and a process with its robots. At the end
every keyframe that was published is compared with the logs, by run, keyframe id and SHA-256 of the
payload. Exit 0 when nothing is lost, altered or unacknowledged, 1 otherwise.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .comparison import Comparison, compare, read_published
from .programs import Site, read_errors
from .robots import FLUSH_S

SAMPLE_S = 0.5
MIN_KILL_S = 10.0
AWAY_S = 3.0
"""How long a killed recorder is away; a router is away for five times as long."""


@dataclass(frozen=True)
class Plan:
    """What is simulated. ``robots`` are those of all sites together."""

    sites: int = 4
    robots: int = 200
    per_second: float = 2.0
    seconds: float = 180.0
    kill: bool = False
    burst: bool = False


@dataclass
class Outcome:
    """What came of it. ``cpu_s`` is processor time by kind of process from the first keyframe on,
    without that of robots that were killed; ``lags_s`` are sorted seconds from publishing to the
    acknowledgement of a synced keyframe."""

    plan: Plan
    wall_s: float
    found: Comparison
    lags_s: list[float]
    cpu_s: dict[str, float]
    queue_peaks: list[int]
    missing: int
    unacknowledged: int
    refused: int
    resumed: int
    done: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Every keyframe that was published is in a log with the same bytes, and acknowledged."""
        found = self.found
        wrong = found.lost or found.altered or found.rejected or found.damage or self.faults
        return not (wrong or self.missing or self.unacknowledged or self.refused)

    def lag_ms(self, part: float) -> float:
        """A quantile of the lags, milliseconds."""
        if not self.lags_s:
            return float("nan")
        return 1e3 * self.lags_s[min(len(self.lags_s) - 1, int(part * len(self.lags_s)))]

    def cpu_us(self, kind: str) -> float:
        """Processor time of a kind of process for each keyframe, microseconds."""
        return 1e6 * self.cpu_s[kind] / max(1, self.found.published)

    def document(self) -> dict[str, Any]:
        """The outcome as JSON."""
        found = self.found
        return {
            "sites": self.plan.sites,
            "robots": self.plan.robots,
            "rate_hz": self.plan.per_second,
            "seconds": self.plan.seconds,
            "kill": self.plan.kill,
            "burst": self.plan.burst,
            "published": found.published,
            "stored": found.stored,
            "lost": len(found.lost),
            "altered": len(found.altered),
            "unknown": len(found.unknown),
            "duplicates": found.duplicates,
            "rejected": found.rejected,
            "loss_events": found.loss_events,
            "missing": self.missing,
            "unacknowledged": self.unacknowledged,
            "refused": self.refused,
            "resumed": self.resumed,
            "lag_ms": {name: round(self.lag_ms(q), 1) for name, q in QUANTILES.items()},
            "cpu_us_per_keyframe": {kind: round(self.cpu_us(kind), 1) for kind in self.cpu_s},
            "queue_peaks": self.queue_peaks,
            "log_bytes": found.log_bytes,
            "wall_s": round(self.wall_s, 1),
            "load_1min": round(os.getloadavg()[0], 1),
            "done": self.done,
            "faults": [*self.faults, *found.damage],
        }


_pause = threading.Event().wait
QUANTILES = {"p50": 0.5, "p99": 0.99, "worst": 1.0}


class Simulation:
    """The sites of a plan at work; a context manager."""

    def __init__(self, plan: Plan, folder: Path, say: Callable[[str], None]) -> None:
        self._plan = plan
        self._say = say
        self._done: list[str] = []
        self._faults: list[str] = []
        self._summaries: list[dict[str, Any]] = []
        each, more = divmod(plan.robots, plan.sites)
        self._folder = folder
        (folder / "spools").mkdir()
        self._sites = [
            Site(i, folder, each + (i < more), plan.per_second, plan.seconds, not plan.burst)
            for i in range(plan.sites)
        ]

    def run(self) -> Outcome:
        """Start everything, let the robots publish, end everything, compare."""
        for site in self._sites:
            site.start_router()
            site.start_recorder()
            site.start_robots(self._plan.seconds)
        self._say(f"{self._plan.sites} routers, recorders and groups of robots are ready")
        before = self._cpu_s()
        begin = time.monotonic()
        for site in self._sites:
            site.go()
        self._watch(begin)
        for site in self._sites:
            if site.fleet.wait(FLUSH_S + 60.0):
                self._faults.append(f"{site.fleet.name}: {site.fleet.errors.read_text()[-500:]}")
            else:
                self._summaries.append(dict(site.robots_summary()))
        wall_s = time.monotonic() - begin
        missing = sum(self._end_recorder(site) for site in self._sites)
        for site in self._sites:
            site.router.end(signal.SIGINT)
        self._say("comparing what was published with the logs")
        published = read_published(self._folder.glob("published-*.jsonl"))
        found = compare(published, [(site.log, site.key) for site in self._sites])
        used = {kind: seconds - before[kind] for kind, seconds in self._cpu_s().items()}
        used["robots"] = sum(summary["cpu_s"] for summary in self._summaries)
        return Outcome(
            plan=self._plan,
            wall_s=wall_s,
            found=found,
            lags_s=sorted(lag for summary in self._summaries for lag in summary["lags_s"]),
            cpu_s=used,
            queue_peaks=[int(site.queue_peak) for site in self._sites],
            missing=missing,
            unacknowledged=sum(summary["unacknowledged"] for summary in self._summaries),
            refused=sum(summary["refused"] for summary in self._summaries),
            resumed=sum(summary["resumed"] for summary in self._summaries),
            done=self._done,
            faults=self._faults,
        )

    def _cpu_s(self) -> dict[str, float]:
        return {
            "robots": 0.0,
            "router": sum(site.router.cpu_s() for site in self._sites),
            "recorder": sum(site.recorder.cpu_s() for site in self._sites),
        }

    def _watch(self, begin: float) -> None:
        """Until the robots have ended: sample the queues, and kill what is to be killed."""
        waiting = self._accidents() if self._plan.kill else []
        # At one site one after the other: a recorder cannot start while its router is away.
        with ThreadPoolExecutor(4 if len(self._sites) >= 4 else 1) as threads:
            running: list[Future[None]] = []
            while waiting or running or self._robots_run():
                now = time.monotonic() - begin
                if waiting and waiting[0][0] <= now:
                    running.append(threads.submit(waiting.pop(0)[1], self._plan.seconds - now))
                for accident in [accident for accident in running if accident.done()]:
                    accident.result()
                    running.remove(accident)
                for site in self._sites:
                    site.sample()
                if now > self._plan.seconds + FLUSH_S + 60.0:
                    self._faults.append("the robots do not end")
                    return
                _pause(SAMPLE_S)

    def _robots_run(self) -> bool:
        return any(site.fleet.process.poll() is None for site in self._sites)

    def _accidents(self) -> list[tuple[float, Callable[[float], None]]]:
        """When, and what; each of another site while there are enough."""
        sites = [self._sites[i % len(self._sites)] for i in range(4)]
        away = min(AWAY_S, self._plan.seconds / 30)
        happens: list[Callable[[float], None]] = [
            lambda _: self._kill_recorder(sites[0], away),
            lambda _: self._kill_router(sites[1], 5 * away),
            lambda left: self._kill_robots(sites[2], left),
            lambda _: self._fill_disk(sites[3], away),
        ]
        begins = (0.15, 0.35, 0.55, 0.7)
        return [(b * self._plan.seconds, act) for b, act in zip(begins, happens, strict=True)]

    def _note(self, text: str) -> None:
        self._done.append(text)
        self._say(text)

    def _kill_recorder(self, site: Site, away_s: float) -> None:
        site.recorder.end(signal.SIGKILL)
        self._note(f"killed {site.recorder.name}; it is away for {away_s:.1f} s")
        _pause(away_s)
        site.start_recorder()

    def _kill_router(self, site: Site, away_s: float) -> None:
        site.router.end(signal.SIGKILL)
        self._note(f"killed {site.router.name}; it is away for {away_s:.1f} s")
        _pause(away_s)
        site.start_router()

    def _kill_robots(self, site: Site, left_s: float) -> None:
        site.fleet.end(signal.SIGKILL)
        self._note(f"killed {site.fleet.name}; they start again with what their spools hold")
        begin = time.monotonic()
        site.start_robots(max(1.0, left_s - 2.0))
        site.go()
        self._say(f"{site.fleet.name} were away for {time.monotonic() - begin:.1f} s")

    def _fill_disk(self, site: Site, away_s: float) -> None:
        site.fill_disk()
        try:
            code = site.recorder.wait()
        except subprocess.TimeoutExpired:
            self._faults.append(f"{site.recorder.name} goes on with a full disk, or got nothing")
            return
        self._note(f"filled the disk of {site.recorder.name}, which ended with exit {code}")
        if code != 1:
            self._faults.append(f"{site.recorder.name} ended with {code} on a full disk, not 1")
        _pause(away_s)
        site.start_recorder()

    def _end_recorder(self, site: Site) -> int:
        """End a recorder with Ctrl-C; the keyframes that its log lacks."""
        recorder = site.recorder
        code = recorder.end(signal.SIGINT)
        if code not in (0, 3):
            self._faults.append(f"{recorder.name} ended with {code}: {read_errors(recorder)[-3:]}")
            return 0
        return int(json.loads(recorder.output.read_text())["missing"])

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *_: object) -> None:
        for site in self._sites:
            site.close()


def lines_of(outcome: Outcome) -> list[str]:
    """The outcome for people."""
    found, cpu = outcome.found, outcome.cpu_s
    plan = outcome.plan
    cores = ", ".join(f"{kind} {seconds / outcome.wall_s:.2f}" for kind, seconds in cpu.items())
    each = ", ".join(f"{kind} {outcome.cpu_us(kind):,.0f}" for kind in cpu)
    lags = ", ".join(f"{name} {outcome.lag_ms(q):,.0f}" for name, q in QUANTILES.items())
    return [
        (
            f"{plan.robots} robots at {plan.sites} sites, {plan.per_second:g} keyframes/s each, "
            f"{plan.seconds:.0f} s; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
        ),
        (
            f"published {found.published:,}, in the logs {found.stored:,}, lost {len(found.lost)}, "
            f"altered {len(found.altered)}, rejected {found.rejected}"
        ),
        (
            f"sent again and in a log twice {found.duplicates:,}, resumed from spools "
            f"{outcome.resumed:,}, in a log and not noted as published {len(found.unknown)}, "
            f"loss events {found.loss_events}"
        ),
        (
            f"not acknowledged {outcome.unacknowledged}, refused {outcome.refused}, missing by the "
            f"recorders' count {outcome.missing}"
        ),
        f"publish to synced and acknowledged, ms: {lags}",
        f"processors used: {cores}",
        f"processor µs for each keyframe: {each}",
        f"most messages in a recorder's queue: {max(outcome.queue_peaks)} of 16,384",
        (
            f"logs: {found.log_bytes / 1e6:,.0f} MB, "
            f"{found.log_bytes / max(1, found.stored + found.duplicates):,.0f} bytes an event"
        ),
        *(f"lost: run {run_id}, keyframe {number}" for run_id, number in found.lost[:10]),
        *(f"fault: {fault}" for fault in [*outcome.faults, *found.damage][:10]),
        "nothing is lost" if outcome.good else "FAILED",
    ]


def simulate(plan: Plan, folder: Path, say: Callable[[str], None]) -> Outcome:
    """Simulate a plan in an empty folder."""
    with Simulation(plan, folder, say) as simulation:
        return simulation.run()


def main() -> int:
    """0 when nothing was lost."""
    about = __doc__.splitlines()[0] if __doc__ else None
    parser = argparse.ArgumentParser(prog="scripts/simulate_fleet", description=about)
    plan = Plan()
    parser.add_argument("--sites", type=int, default=plan.sites, help="default 4")
    parser.add_argument("--robots", type=int, default=plan.robots, help="in all; default 200")
    parser.add_argument("--rate", type=float, default=plan.per_second, help="keyframes/s; 2")
    parser.add_argument("--seconds", type=float, default=plan.seconds, help="default 180")
    parser.add_argument(
        "--kill",
        action="store_true",
        help="kill a recorder, a router and the robots of a site, and fill a recorder's disk",
    )
    parser.add_argument("--burst", action="store_true", help="all robots publish at once")
    parser.add_argument("--folder", type=Path, help="on the disk to use; default: /tmp")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    args = parser.parse_args()
    if not 1 <= args.sites <= args.robots or args.rate <= 0 or args.seconds * args.rate < 1:
        parser.error("at least one site, a robot for each, and a keyframe of each robot")
    if args.kill and args.seconds < MIN_KILL_S:
        parser.error(f"--kill needs {MIN_KILL_S:.0f} seconds or more")
    plan = Plan(args.sites, args.robots, args.rate, args.seconds, args.kill, args.burst)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # end the programs, too
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(dir=args.folder))
        try:
            outcome = simulate(plan, Path(folder), lambda text: print(text, file=sys.stderr))
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
    print(json.dumps(outcome.document()) if args.json else "\n".join(lines_of(outcome)))
    return 0 if outcome.good else 1


if __name__ == "__main__":
    sys.exit(main())
