"""Faces to build models from and scans to fit: the bundled simulated faces, and loaders of open data sets."""
