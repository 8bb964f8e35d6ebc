"""A random differential test of the whole product, run by ``scripts/differ``.

A random log with every kind of event (`growing_log`) grows step by step. After each step every way
to a map (`timelines`, `databases`) must give what a fold of its own from the first event gives, at
random W and V, and what it gave before the log had grown.
"""
