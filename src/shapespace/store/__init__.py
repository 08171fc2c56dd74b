"""Results of many fits in a few files: a manifest, Parquet tables, Zarr surfaces; and one way to read them all."""
