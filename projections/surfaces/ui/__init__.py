"""The web debugger: a page about one log, and its HTTP interface (docs/ui.md). The page gets a
map's whole history as arrays and computes the map at any offset from them; texts, digests and maps
under other settings are computed by the server.
"""
