"""Messages as columns in Parquet files: tables of fields, and payloads with their arrays."""
