"""The kept history of a log's map: deltas as columns, on disk and in memory, and their records."""
