"""The map as data: the view, its digest, snapshots, the fold of a log, exports."""
