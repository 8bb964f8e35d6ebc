"""The web debugger: a page over one log, and the interface that it asks (docs/ui.md).

The page gets a map's whole history as arrays and computes the map at any offset by itself; texts,
digests and other settings are asked from the server.
"""
