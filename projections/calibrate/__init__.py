"""Reading the constants of fusion by evidence off the map's own revisits."""
