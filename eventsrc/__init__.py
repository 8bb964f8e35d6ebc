"""eventsrc: the append-only log of what a robot saw and where it was.

It never imports `projections`, which interprets the log.
"""
