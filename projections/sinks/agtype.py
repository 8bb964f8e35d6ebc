"""Values as agtype text: what AGE's input function reads back as exactly the same value.

agtype's text is JSON with two differences that matter: integer and float are different types, and a
number is a float exactly when it is written with a point or an exponent. Python's ``repr`` of a
float always has one of the two and is the shortest text that names that float; the server reads it
back to the same bits. Strings are escaped as JSON has it: quote, backslash and control characters.

Nothing here is query text. The result is a *value*: a bind parameter or a field of COPY data.
"""

from json.encoder import encode_basestring


def text(value: str) -> str:
    """A string. It must hold no NUL and no lone surrogate, which PostgreSQL cannot store."""
    return encode_basestring(value)


def number(value: float) -> str:
    """A finite float, -0.0 and 1e22 included; ints are written by ``str``."""
    written = repr(float(value))
    if written[-1] in "fn":  # inf, nan
        raise ValueError(f"{value} is no number a graph can hold")
    return written
