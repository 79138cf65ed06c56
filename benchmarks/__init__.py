"""Benchmarks of hybridlog: `python -m benchmarks` lists them."""
