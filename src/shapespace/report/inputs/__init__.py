"""Saved results read back for reports and the viewer: fits, correspondences, populations.

Entry points: `saved_fits`, `correspondence_folder`. Imported by `report.pages`, `report.notebook` and `viewer`.
"""
