"""projections: what the log means. A deterministic fold, its views and its databases."""
