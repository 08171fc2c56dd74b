"""Base class of the results of analyses: how they are saved and shown, which the layer `report` implements."""

from __future__ import annotations

from pathlib import Path

from shapespace.lazy import lazy_import


class AnalysisResult:
    """The result of an analysis of a cohort."""

    def save(self, folder: Path | str) -> Path:
        """Write the report, tables, arrays and meshes to a folder.

        `shapespace report FOLDER` draws the report from these files.

        Args:
            folder: is created if it does not exist.

        Returns:
            The path of analysis.json.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        return lazy_import("save_analysis")(self, folder)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_analysis")(self)
