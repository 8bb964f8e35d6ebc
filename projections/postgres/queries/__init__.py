"""Questions to the live databases, as library functions; nothing here writes."""
