"""Copies of recordings: to directories, servers and buckets."""
