"""The robot's side: publish envelopes, and keep each until a recorder acknowledges it."""
