"""Programs that break things on purpose, for the tests and for `scripts/chaos_*`."""
