"""Calibration: estimate the constants of fusion by evidence from the map's own revisits."""
