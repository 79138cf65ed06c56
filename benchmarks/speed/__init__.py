"""The speed targets, measured: each side in its own process, ratios from one run."""
