"""The map as data: the view, its digest, the fold of a log, exports."""
