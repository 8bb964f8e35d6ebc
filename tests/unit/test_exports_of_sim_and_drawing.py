"""Public names of sim and drawing; matplotlib is not imported before something is drawn."""

import subprocess
import sys

import eventsrc.adapters.sim
import projections.adapters.drawing


def test_sim() -> None:
    assert eventsrc.adapters.sim.__all__ == [
        "DEFAULT_SEED",
        "House",
        "SimulatedRun",
        "build_house",
        "occupancy_map",
        "simulate_run",
    ]


def test_drawing() -> None:
    names = ["HousePlan", "LostRobot", "MergeMark", "Spot", "draw_map", "map_png", "plan_of"]
    assert projections.adapters.drawing.__all__ == names


def test_the_command_line_loads_no_matplotlib_until_something_is_drawn() -> None:
    script = "import sys, projections.surfaces.cli; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
