"""Sizes, waits and costs of the product that tests make smaller, each named once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

PLACES = {
    "align_piece_bytes": "hybridlog.across.align._PIECE_BYTES",
    "row_group_rows": "hybridlog.columns.column_file._GROUP_ROWS",
    "shared_file_recordings": "hybridlog.columns.table_writer.MAX_SHARED_RECORDINGS",
    "shared_file_rows": "hybridlog.columns.table_writer.MAX_SHARED_ROWS",
    "long_table_rows": "hybridlog.columns.table_writer.LONG_ROWS",
    "group_bytes": "hybridlog.follow.follower._GROUP_BYTES",
    "short_recording_s": "hybridlog.follow.child.SHORT_S",
    "table_left_bytes": "hybridlog.columns.table_writer._LEFT",
    "table_pending_bytes": "hybridlog.columns.table_writer._PENDING",
    "table_reserve_bytes": "hybridlog.columns.table_writer._RESERVE",
    "group_rows": "hybridlog.follow.follower._GROUP_ROWS",
    "bag_window_bytes": "hybridlog.formats.rosbag1.reader._WINDOW",
    "output_held_bytes": "hybridlog.formats.tables.HELD_BYTES",
    "frame_block_rows": "hybridlog.frames.answer._BLOCK_ROWS",
    "clock_wait_s": "hybridlog.live.recorder._CLOCK_WAIT_S",
    "full_manifest_bytes": "hybridlog.live.recorder._FULL_BYTES",
    "slow_write_s": "hybridlog.live.recorder._SLOW_WRITE_S",
    "foxglove_ping_s": "hybridlog.live.sources.foxglove.connection._PING_S",
    "foxglove_message_bytes": "hybridlog.live.sources.foxglove.connection.Session.max_bytes",
    "foxglove_channels": "hybridlog.live.sources.foxglove.connection._MAX_CHANNELS",
    "foxglove_pause_s": "hybridlog.live.sources.foxglove.connection._PAUSE_S",
    "foxglove_unread_bytes": "hybridlog.live.sources.foxglove.connection._MAX_UNREAD",
    "foxglove_retry_s": "hybridlog.live.sources.foxglove.connection._RETRY_S",
    "ros2_hello_s": "hybridlog.live.sources.ros2.source.HELLO_S",
    "ros2_hand_over_s": "hybridlog.live.sources.ros2.source._HAND_OVER_S",
    "ros2_pause_s": "hybridlog.live.sources.ros2.source._PAUSE_S",
    "min_threaded_bytes": "hybridlog.query.chunk_scan._MIN_THREADED_BYTES",
    "latched_held": "hybridlog.query.latching.MAX_HELD",
    "sampled_periods": "hybridlog.query.intervals._SAMPLED",
    "planner_group_growth": "hybridlog.query.planner._GROUP_GROWTH",
    "document_slab_bytes": "hybridlog.schema.document._SLAB",
    "clients_wait_s": "hybridlog.index.of_store._CLIENTS_WAIT_S",
    "playback_sent": "hybridlog.view.playback._MAX_SENT",
    "sql_seconds": "hybridlog.view.routes.ask.SQL_SECONDS",
    "catalog_busy_s": "hybridlog_storage.cells._WAIT_S",
    "matches": "hybridlog.drawing.times.MAX_MATCHES",
    "copy_wait_s": "hybridlog_storage.copy.LOCK_WAIT_S",
    "server_copy_wait_s": "hybridlog_storage.server.LOCK_WAIT_S",
    "manifest_bytes": "hybridlog_storage.manifest.MAX_BYTES",
    "manifest_wait_s": "hybridlog_storage.manifests.WAIT_S",
    "inserted_documents": "hybridlog_storage.mongo.database.BATCH_DOCUMENTS",
    "inserted_bytes_together": "hybridlog_storage.mongo.database._MAX_COMMAND_BYTES",
    "mongod_start_s": "hybridlog_storage.mongo.mongod.START_LIMIT_S",
    "segment_chunks": "hybridlog_storage.segments.segment_writer._MAX_CHUNKS",
    "segment_parts": "hybridlog_storage.segments.segment_writer._MAX_PARTS",
    "bucket_whole_bytes": "hybridlog_storage.remote.bucket.PART_BYTES",
    "bucket_part_bytes": "hybridlog_storage.remote.bucket._PART",
    "bucket_retry_s": "hybridlog_storage.remote.bucket._RETRY_S",
    "sync": "hybridlog_storage.disk.files.System.sync",
    "connection_patience_s": "hybridlog.view.server.BoundedConnection.patience_s",
    "directory_is_writable": "hybridlog_storage.disk.directory.StoreDirectory.is_writable",
    "index_interval": "hybridlog.live.recording.follow_interval_s",
    "recording_filled": "hybridlog.live.recording.LiveRecording.filled",
}


class Limit:
    """Sets limits until the end of a test: `limit(long_table_rows=1000)`."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._patch = patch

    def __call__(self, **values: Any) -> None:
        for name, value in values.items():
            self._patch.setattr(PLACES[name], value)


@contextmanager
def limits(**values: Any) -> Iterator[None]:
    """Set limits for a while."""
    with pytest.MonkeyPatch.context() as patch:
        Limit(patch)(**values)
        yield
