"""Commands made from what a person types: resolved in the map as it is, checked, and recorded.

`current` is that map, `make` builds the commands, `conflicts` names a command that stands in the
way, `record` appends, `effect` says what a command changes.
"""
