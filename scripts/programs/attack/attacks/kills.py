"""SIGKILL to a recorder at random moments, while two robots publish under one run id."""

import signal
import subprocess

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.oracle import Oracle
from scripts.programs.attack.robot import Robot

LONGEST_LIFE_S = 0.8
FLUSH_S = 60.0


def attack(arena: Arena) -> None:
    """Three lives of recorders, and one that is left in peace until everything is acknowledged."""
    log, oracle, endpoint = arena.folder / "log", Oracle(), arena.router()
    robots = [
        arena.stack.enter_context(
            Robot(endpoint, arena.folder / f"robot-{n}", oracle, run_id="run", per_second=150.0)
        )
        for n in range(2)
    ]
    for robot in robots:
        robot.start()
    for _ in range(3):
        recorder = arena.start("recorder", "record", log, "--connect", endpoint)
        if arena.rng.random() < 0.8:
            recorder.wait_for("recording ")
        try:
            code = recorder.wait(arena.rng.uniform(0.0, LONGEST_LIFE_S))
            arena.complain(f"a recorder ended by itself with {code}: {recorder.lines[-1:]}")
        except subprocess.TimeoutExpired:  # the wait has killed it
            assert recorder.process.returncode == -signal.SIGKILL
        for robot in robots:
            robot.note_acknowledged()
        if any(log.glob("*.mcap*")):
            if arena.rng.random() < 0.5:
                arena.run("reader", "log", "recover", log, codes=(0, 3))
            arena.judge(oracle, log)
    last = arena.recorder(log, endpoint)
    finished = [robot.finish(FLUSH_S) for robot in robots]
    if not all(finished):
        arena.complain("a recorder that was left in peace did not acknowledge everything")
    arena.finish(last)
    for robot in robots:
        robot.note_acknowledged()
    arena.judge(oracle, log)
    arena.run("reader", "log", "verify", log, codes=(0, 3))
