"""Which versions of Apache AGE can be kept from writing for a role that may only read.

The clauses of ``cypher()`` that write do not run as SQL's UPDATE and DELETE do, and check less.
Tried with a role that has nothing but USAGE and SELECT:

==================================================  =========  ================
what the role does                                  AGE 1.5.0  AGE 1.7.0, 1.8.0
==================================================  =========  ================
``MATCH (n) SET``, ``REMOVE``, ``DELETE``           written    refused
the same on a vertex or an edge that the query      written    written
makes up: ``WITH {id: …, …}::vertex AS n SET …``
the same with row-level security on the tables      written    not written
==================================================  =========  ================

A read-only transaction and a revoked EXECUTE on ``cypher`` change nothing of this. AGE 1.6 has not
been tried and is taken to be like 1.5.
"""

import re
from typing import Final

FIRST_TO_ENFORCE: Final = (1, 7)


def enforces_row_security(version: str) -> bool:
    """Whether this version of AGE applies row-level security to what ``cypher()`` writes."""
    found = re.match(r"(\d+)\.(\d+)", version)
    return found is not None and (int(found[1]), int(found[2])) >= FIRST_TO_ENFORCE
