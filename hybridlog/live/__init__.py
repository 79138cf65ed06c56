"""The recorder of a running robot: policies, snapshots, statistics, control socket, sources."""

from hybridlog.live.recording import LiveOptions, LiveRecording

__all__ = ["LiveOptions", "LiveRecording"]
