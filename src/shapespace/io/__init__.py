"""Files: readers with limits on size and memory, atomic writers, and conversion of meshes of other tools.

Entry points: `meshes.mesh_io`, `landmarks.landmark_io`, `volume_io`, `tables.table_io`, `interop`. Imported by
every layer above; does not depend on models.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.io.interop import as_mesh
    from shapespace.io.landmarks.configuration_io import read_configurations, write_configurations
    from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
    from shapespace.io.landmarks.landmark_io import read_landmarks, write_landmarks
    from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
    from shapespace.io.trees import Tree, read_tree
    from shapespace.io.volume_io import read_volume
    from shapespace.types import LabelVolume

__all__ = [
    "LabelVolume",
    "LandmarkConfigurations",
    "Tree",
    "as_mesh",
    "read_configurations",
    "read_landmarks",
    "read_mesh",
    "read_tree",
    "read_volume",
    "write_configurations",
    "write_landmarks",
    "write_mesh",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "io.interop": ("as_mesh",),
        "io.landmarks.landmark_io": ("read_landmarks", "write_landmarks"),
        "io.meshes.mesh_io": ("read_mesh", "write_mesh"),
        "io.volume_io": ("read_volume",),
        "types": ("LabelVolume",),
        "io.landmarks.configuration_io": ("read_configurations", "write_configurations"),
        "io.landmarks.landmark_configurations": ("LandmarkConfigurations",),
        "io.trees": ("Tree", "read_tree"),
    },
)
