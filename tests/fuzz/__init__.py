"""What reads bytes of others, fed with bytes that are almost right.

    python -m tests.fuzz [--seconds S] [TARGET …]   guided by coverage (atheris), by hand
    tests/property/test_fuzz.py                     a few inputs of each, in the default tests

A `Target` knows valid inputs, how to damage one so that its checksums are right again as a rule,
and what must hold of every input: only the documented errors, in bounded time and memory.
"""
