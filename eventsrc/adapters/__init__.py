"""Sources of envelopes: detectors on pictures, the simulator, other embeddings for a log."""
