"""Files: readers with bounds, writers that leave whole files, and meshes of other tools.

Entry points: `meshes.mesh_io`, `landmarks.landmark_io`, `volumes.volume_io`, `tables.table_io`, `interop`. Imported by
every layer above; knows no model.
"""
