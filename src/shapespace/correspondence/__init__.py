"""Dense correspondence from raw scans, without a model.

Entry point: `groupwise.correspond`. Imported by `batch`, `report` and above.
"""
