"""An observation that may be fused into an Object."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope import DetId
from projections.deltas import ObservationOrdinal

FusibleObservation: TypeAlias = tuple[ObservationOrdinal, DetId, str, NDArray[np.float64], int]
"""Ordinal, det_id, class name, unit vector of the map's space, its squared norm."""
