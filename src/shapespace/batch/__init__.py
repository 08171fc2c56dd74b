"""Work on many scans: jobs, executors, sinks, records that a later run reuses.

Entry points: `run`, `executors`. Imported by `commands` and above.
"""
