"""Simulated runs, each made once a process: one takes half a second."""

from functools import cache

from eventsrc.adapters.sim import SimulatedRun, simulate_run


@cache
def simulated(seed: int = 7, run: str = "a") -> SimulatedRun:
    """The run, which tests may only read."""
    return simulate_run(seed, run)
