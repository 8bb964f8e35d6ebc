"""Make logs/sample: the exploring run through the simulated house 7, as a `full` log with walls.

    scripts/make_sample [LOG]

It begins as the log of the demo does, with settings and walls. The other events are the payloads
of ``mapfold simulate``, byte for byte. All are logged at the time of the robot, so only the log's
id differs from one making to the next.
"""

import sys
from pathlib import Path

from eventsrc.adapters.sim import DEFAULT_SEED, simulate_run
from eventsrc.adapters.sim.simulation import EXPLORER, start_of
from eventsrc.log import LogWriter
from eventsrc.record.append import append_payload
from projections.surfaces.demo.recorded_run import begin_log

LOG = Path("logs/sample")
KEY = "tb/detections"


def make_sample(log: Path) -> None:
    """Write the sample into a new log."""
    run, start_ns = simulate_run(DEFAULT_SEED, EXPLORER), round(start_of(EXPLORER) * 1e9)
    with LogWriter(log, clock=lambda: start_ns) as writer:
        begin_log(writer, run.house, start_ns)
        for payload, pose in zip(run.payloads, run.true_poses, strict=True):
            append_payload(writer, KEY, payload, logged_ns=start_ns + round(pose.time_s * 1e9))


if __name__ == "__main__":
    made = Path(sys.argv[1]) if sys.argv[1:] else LOG
    if any(made.glob("*.mcap*")):
        sys.exit(f"{made}: there is a log already; remove it, or name another folder")
    make_sample(made)
