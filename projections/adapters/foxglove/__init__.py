"""The map for Foxglove: as a recording, and from a server that its timeline drives.

Needs the extra ``[foxglove]``, which brings the Foxglove SDK.
"""
