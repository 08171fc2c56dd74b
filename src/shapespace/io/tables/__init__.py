"""Tables of subjects: CSV and Excel files.

Entry points: `table_io.table_rows`, `table_io.read_rows`. Imported by every layer above `geometry`.
"""
