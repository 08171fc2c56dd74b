"""Surfaces in correspondence from raw scans, with no model to begin with."""
