"""The map for the Rerun viewer, as a recording of how it came about.

Needs the extra ``[rerun]``, which brings the Rerun SDK.
"""
