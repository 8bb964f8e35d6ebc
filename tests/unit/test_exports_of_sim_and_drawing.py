"""Public names of sim, drawing and demo; matplotlib is not imported before something is drawn."""

import subprocess
import sys

import eventsrc.sim
import projections.demo
import projections.drawing


def test_sim() -> None:
    assert eventsrc.sim.__all__ == [
        "DEFAULT_SEED",
        "House",
        "SimulatedRun",
        "build_house",
        "occupancy_map",
        "simulate_run",
    ]


def test_drawing() -> None:
    names = ["Bridge", "Floor", "LostRobot", "Spot", "draw_map", "floor_of", "map_png"]
    assert projections.drawing.__all__ == names


def test_demo() -> None:
    assert projections.demo.__all__ == ["DemoOptions", "run_demo"]


def test_the_command_line_loads_no_matplotlib_until_something_is_drawn() -> None:
    script = "import sys, projections.cli; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
