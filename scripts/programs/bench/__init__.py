"""Benchmarks: what the scripts/bench_* run."""
