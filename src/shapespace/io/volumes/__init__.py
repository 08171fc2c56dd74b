"""Readers of label volumes: NIfTI and NRRD.

Entry point: `volume_io.read_volume`. Imported by `commands` and `datasets`.
"""
