"""Geometry of triangle meshes: closest points, alignment, topology, remeshing; no models.

Entry points: `closest`, `procrustes`, `doctor`, `distance`. Imported by every layer above, never by `io`.
"""
