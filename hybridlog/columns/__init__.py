"""Messages as columns in Parquet files: tables of topics, and fields of expired messages."""
