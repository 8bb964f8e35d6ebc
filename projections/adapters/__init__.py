"""The map for other programs: Foxglove, Rerun, files, pictures, fleets."""
