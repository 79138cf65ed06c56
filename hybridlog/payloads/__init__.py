"""Payloads as columns: arrays of ended recordings in Parquet files, exact to the byte."""
