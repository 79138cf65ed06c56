"""Store maintenance: recovery, index, verification, repair, removal, import.

Segments and manifests are the truth. The functions here compare catalog and index with them
and repair catalog and index, never the reverse. The intent is on the disk before the first
destructive step, and the next command that changes the store finishes interrupted work.

Imports: columns, follow, index, query, record.
"""
