"""SQL over topics: DuckDB reads the tables of topics as the store holds them."""
