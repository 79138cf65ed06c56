"""Parquet tables of topics: written beside the segments, read for answers."""
