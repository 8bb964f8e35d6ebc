"""Many robots at several sites, with real routers and recorders: scripts/simulate_fleet."""
