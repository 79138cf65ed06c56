"""Messages as columns in Parquet files: tables of topics, and rows of logs that are gone.

Imports: arrays, index, schema.
"""
