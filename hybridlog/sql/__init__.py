"""SQL over topics: DuckDB reads the tables of topics as the store holds them.

Imports: columns, frames, query, schema.
"""

import os

# What Arrow reserves would count as taken; it reads this when it is loaded.
os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")
