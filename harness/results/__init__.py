"""Result rows: schema, Parquet store, queries, remote storage."""
