"""The recorder of a running robot: policies, statistics, triggers, state file, sources."""

from hybridlog.live.recording import LiveOptions, LiveRecording

__all__ = ["LiveOptions", "LiveRecording"]
