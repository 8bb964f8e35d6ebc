"""The rigid transform between two map frames, from the Objects that both maps have."""
