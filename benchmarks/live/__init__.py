"""Recording a running robot under load, and when things fail."""
