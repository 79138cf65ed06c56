"""hybridlog records what a robot says and makes it answerable.

```python
import hybridlog as hl

with hl.open("robot-logs") as store:
    frame = store.topic("scan").between("+10s", "+11s").to_pandas()
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.record.recorder import RecordOptions
    from hybridlog.store import Store
    from hybridlog.store import open_store as open  # noqa: A004

__all__ = ["Message", "Query", "RecordOptions", "Store", "__version__", "open"]

__version__ = "0.1.0"

_PLACES = {
    "Message": ("hybridlog.message", "Message"),
    "Query": ("hybridlog.query.query", "Query"),
    "RecordOptions": ("hybridlog.record.recorder", "RecordOptions"),
    "Store": ("hybridlog.store", "Store"),
    "open": ("hybridlog.store", "open_store"),
}


def __getattr__(name: str) -> object:
    """Load a public name when it is first used, so that `import hybridlog` costs nothing."""
    from importlib import import_module

    try:
        module, attribute = _PLACES[name]
    except KeyError:
        raise AttributeError(f"module 'hybridlog' has no attribute {name!r}") from None
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
