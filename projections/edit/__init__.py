"""Corrections from user input: resolved in the current map, checked, and recorded as commands.
`current` is that map, `make` builds commands, `conflicts` finds earlier commands that contradict
them, `record` appends them, `effect` computes what a command changes.
"""
