"""Recording a running robot: what is taken, what is given up, and how that is told."""

from hybridlog.live.recording import LiveOptions, LiveRecording

__all__ = ["LiveOptions", "LiveRecording"]
