"""Benchmarks of `mapfold fleet`; run by scripts/bench_fleet."""
