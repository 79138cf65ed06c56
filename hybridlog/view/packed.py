"""Arrays of numbers for the page, which it uses as they came: nothing is parsed.

The body is a length (uint32), a header of that length in JSON, padded with spaces so that what
follows is aligned, and then the arrays one after the other, all little endian. `arrays` of the
header has the name, the type and the number of elements of each.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from starlette.responses import Response

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_ALIGNED = 8


def packed_response(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[np.floating[Any]]]
) -> Response:
    """Plain values, and arrays of float32 or float64 by name; the wide ones come first."""
    ordered = sorted(arrays.items(), key=lambda one: -one[1].dtype.itemsize)
    described = [
        {"name": name, "type": f"float{array.dtype.itemsize * 8}", "count": array.size}
        for name, array in ordered
    ]
    values = {**header, "arrays": described}
    text = json.dumps(values, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    parts = [struct.pack("<I", len(text)), text]
    parts += [
        array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes() for _, array in ordered
    ]
    return Response(b"".join(parts), media_type="application/octet-stream")
