"""Readers and writers of meshes and point clouds, one module per file format.

Entry points: `mesh_io.read_mesh`, `mesh_io.write_mesh`. Imported by every layer above `geometry`.
"""
