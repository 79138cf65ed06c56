"""The recorder of a running robot: policies, statistics, triggers, state file, sources.

Imports: columns, follow, formats, maintenance, query, record, schema.
"""

from hybridlog.live.recording import LiveOptions, LiveRecording

__all__ = ["LiveOptions", "LiveRecording"]
