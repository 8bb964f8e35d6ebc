"""A simulated house and a robot that drives through it, for trying mapfold without a robot.

Floor plan, furniture, tours, detector noise and embeddings follow from a seed. Random numbers are
integers from named PCG64 streams (`random_streams`), and coordinates are rounded to a tenth of a
millimetre, so that the same seed gives the same payloads on every machine.
"""

from .house import House, build_house, occupancy_map
from .simulation import DEFAULT_SEED, SimulatedRun, simulate_run

__all__ = ["DEFAULT_SEED", "House", "SimulatedRun", "build_house", "occupancy_map", "simulate_run"]
