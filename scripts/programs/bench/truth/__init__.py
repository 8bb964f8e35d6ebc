"""Score the map's Objects on generated buildings against the truth; see ``scripts/bench_truth``."""
