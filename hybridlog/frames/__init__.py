"""Tables of messages: columns to Arrow and pandas, index documents to columns."""

from __future__ import annotations

from hybridlog.frames.from_bson import BsonPart, References, records_from_bson, references
from hybridlog.frames.table import TableBuilder

__all__ = ["BsonPart", "References", "TableBuilder", "records_from_bson", "references"]
