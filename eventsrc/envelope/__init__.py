"""What is in a log: envelopes, our own events, commands, occupancy maps; each read from bytes."""
