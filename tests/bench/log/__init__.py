"""How fast the log is, as ratios to something bare measured in the same run."""
