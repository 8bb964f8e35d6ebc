"""Fuzz targets for everything that reads bytes from outside.

    scripts/fuzz [--seconds S] [TARGET …]   guided by coverage (atheris), by hand
    tests/property/test_fuzz.py                     a few inputs of each, in the default tests

A `Target` has valid inputs, mutations that usually make the checksums right again, and a check that
must hold of every input: only the documented errors, in bounded time and memory.
"""
