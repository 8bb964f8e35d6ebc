"""Import messages from files into a log."""
