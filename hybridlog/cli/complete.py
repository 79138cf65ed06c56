"""Tab completion of recordings and topics."""

from __future__ import annotations

import typer


def _store_of(context: typer.Context) -> str | None:
    value = context.params.get("store")
    return str(value) if value is not None else None


def complete_recording(context: typer.Context, incomplete: str) -> list[str]:
    """Ids of recordings that begin with what was typed."""
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.errors import HybridlogError

    from hybridlog.store import store_path

    try:
        ids = StoreDirectory(store_path(_store_of(context))).recording_ids()
    except HybridlogError:
        return []  # a shell that completes has no place for errors
    return [i for i in ids if i.startswith(incomplete)]


def complete_topic(context: typer.Context, incomplete: str) -> list[str]:
    """Topics of the store that begin with what was typed, with or without the slash."""
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.errors import HybridlogError

    from hybridlog.segment_catalog import SegmentCatalog
    from hybridlog.store import store_path

    try:
        catalog = SegmentCatalog(StoreDirectory(store_path(_store_of(context))))
        topics = {c.topic for r in catalog.recordings() for c in r.channels}
    except HybridlogError:
        return []
    return sorted(t for t in topics if t.startswith((incomplete, f"/{incomplete}")))
