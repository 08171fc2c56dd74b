"""Dense correspondence from raw scans, without a model.

Entry point: `groupwise.correspond`. Imported by `batch`, `report` and above.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
    from shapespace.correspondence.groupwise import correspond
    from shapespace.correspondence.joined_parts import join_parts
    from shapespace.correspondence.landmark_transfer import LandmarkCheck, MarkedSpecimens, TransferredLandmarks
    from shapespace.correspondence.settings import CorrespondConfig
    from shapespace.correspondence.symmetric_template import SymmetricMesh, symmetrise

__all__ = [
    "CorrespondConfig",
    "Correspondence",
    "Corresponding",
    "LandmarkCheck",
    "MarkedSpecimens",
    "SymmetricMesh",
    "TransferredLandmarks",
    "correspond",
    "join_parts",
    "symmetrise",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "correspondence.correspondence_result": ("Correspondence", "Corresponding"),
        "correspondence.groupwise": ("correspond",),
        "correspondence.joined_parts": ("join_parts",),
        "correspondence.landmark_transfer": ("LandmarkCheck", "MarkedSpecimens", "TransferredLandmarks"),
        "correspondence.settings": ("CorrespondConfig",),
        "correspondence.symmetric_template": ("SymmetricMesh", "symmetrise"),
    },
)
