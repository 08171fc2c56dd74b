"""Tables of subjects: CSV and Excel files, labels of scans.

Entry points: `table_io.read_table`, `label_table`. Imported by every layer above `geometry`.
"""
