"""Names of files and columns of payloads.

```
recordings/<label>/payloads/topic=<collection>/<schema8>-<number>.parquet
recordings/<label>/payloads.part/    files that are being written
```
"""

from __future__ import annotations

from typing import Final

from hybridlog.tables.layout import RESERVED

PARTS: Final = "payloads.part"
"""Folder of a recording that holds files that are being written."""
IN_PAYLOADS: Final = 5
"""Depth of a file of payloads below the store."""
RECIPE: Final = "recipe"
"""Column with what the original bytes need besides the arrays."""
POINTS: Final = "points"
"""Column of the points of clouds, in place of their `data`."""
PAYLOAD_RESERVED: Final = RESERVED | {"sequence", RECIPE, POINTS}
"""Names that no column of a field has."""


def thinned_name(segment: str) -> str:
    """Name of a segment without moved chunks until it takes the place of the whole one."""
    return f"{segment}.thinned"


def payload_file(folder: str, schema: str, number: int) -> str:
    """Path of a file below `payloads`.

    Args:
        folder: Folder of the topic.
        schema: Hash of what determines the columns.
        number: Number of files of the topic before.
    """
    return f"{folder}/{schema[:8]}-{number:06d}.parquet"
