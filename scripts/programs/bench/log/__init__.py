"""Benchmark of the log, beside bare loops measured in the same run."""
