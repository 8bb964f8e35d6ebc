"""`mapfold demo`: record, replay, map and re-localise on one machine, with real parts."""
