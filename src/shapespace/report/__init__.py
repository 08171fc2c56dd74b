"""Saved results become pictures and one HTML file; nothing is computed here that a result file should hold."""
