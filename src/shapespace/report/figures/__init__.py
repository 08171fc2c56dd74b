"""Figures of shape spaces and fits: a model or a `StagedFit` in, a matplotlib figure out.

    import shapespace as ss
    from shapespace.report import figures
    from shapespace.report.inputs.saved_fits import StagedFit

    result = ss.fit_scan(model, scan)
    figures.signed_maps(StagedFit.of(model, result)).savefig("distances.png")

Pictures of one row share camera and light, one figure has one scale, and the maps are distinguishable for colour-blind
readers. A name is imported on first use, which needs the extra `report`.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.cohort.orientation import oriented
    from shapespace.report.figures.analysis_figures import (
        SIDE_DEG,
        calibration_figure,
        checkerboard_figure,
        confusion_figure,
        curve_figure,
        histogram_figure,
        learning_curve_figure,
        missing_figure,
        morph_figure,
        movement_figure,
        nearness_figure,
        position_std_figure,
        surface_map_figure,
        upright_views,
    )
    from shapespace.report.figures.draw import STAGE_WORDS, encode_webp, publication_style, save_figure
    from shapespace.report.figures.fit_figures import (
        THRESHOLDS_MM,
        aligned_grid,
        coefficients_figure,
        distance_histograms,
        distance_maps,
        error_curves,
        faces_grid,
        history_figure,
        overlay_figure,
        portrait_figure,
        regions_figure,
        signed_maps,
        stages_figure,
        threshold_figure,
    )
    from shapespace.report.figures.landmark_figures import (
        Morphospace,
        deformation_grid_figure,
        landmark_map_figure,
        landmark_vectors_figure,
        morphospace_figure,
        superimposed_landmarks,
    )
    from shapespace.report.figures.model_figures import (
        mean_figure,
        mode_animation,
        modes_figure,
        parts_figure,
        quality_figure,
        spectrum_figure,
    )
    from shapespace.report.figures.population_figures import (
        Coefficients,
        b_plane,
        b_space,
        coefficients_spread,
        density_figure,
        distributions_figure,
        levels_figure,
        over_time_figure,
        scatter_matrix,
    )
    from shapespace.report.inputs.saved_fits import StagedFit

__all__ = [
    "SIDE_DEG",
    "STAGE_WORDS",
    "THRESHOLDS_MM",
    "Coefficients",
    "Morphospace",
    "StagedFit",
    "aligned_grid",
    "b_plane",
    "b_space",
    "calibration_figure",
    "checkerboard_figure",
    "coefficients_figure",
    "coefficients_spread",
    "confusion_figure",
    "curve_figure",
    "deformation_grid_figure",
    "density_figure",
    "distance_histograms",
    "distance_maps",
    "distributions_figure",
    "encode_webp",
    "error_curves",
    "faces_grid",
    "histogram_figure",
    "history_figure",
    "landmark_map_figure",
    "landmark_vectors_figure",
    "learning_curve_figure",
    "levels_figure",
    "mean_figure",
    "missing_figure",
    "mode_animation",
    "modes_figure",
    "morph_figure",
    "morphospace_figure",
    "movement_figure",
    "nearness_figure",
    "oriented",
    "over_time_figure",
    "overlay_figure",
    "parts_figure",
    "portrait_figure",
    "position_std_figure",
    "publication_style",
    "quality_figure",
    "regions_figure",
    "save_figure",
    "scatter_matrix",
    "signed_maps",
    "spectrum_figure",
    "stages_figure",
    "superimposed_landmarks",
    "surface_map_figure",
    "threshold_figure",
    "upright_views",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "report.figures.analysis_figures": (
            "SIDE_DEG",
            "calibration_figure",
            "checkerboard_figure",
            "confusion_figure",
            "curve_figure",
            "histogram_figure",
            "learning_curve_figure",
            "missing_figure",
            "morph_figure",
            "movement_figure",
            "nearness_figure",
            "position_std_figure",
            "surface_map_figure",
            "upright_views",
        ),
        "report.figures.draw": ("STAGE_WORDS", "encode_webp", "publication_style", "save_figure"),
        "report.figures.fit_figures": (
            "THRESHOLDS_MM",
            "aligned_grid",
            "coefficients_figure",
            "distance_histograms",
            "distance_maps",
            "error_curves",
            "faces_grid",
            "history_figure",
            "overlay_figure",
            "portrait_figure",
            "regions_figure",
            "signed_maps",
            "stages_figure",
            "threshold_figure",
        ),
        "report.figures.landmark_figures": (
            "Morphospace",
            "deformation_grid_figure",
            "landmark_map_figure",
            "landmark_vectors_figure",
            "morphospace_figure",
            "superimposed_landmarks",
        ),
        "report.figures.model_figures": (
            "mean_figure",
            "parts_figure",
            "mode_animation",
            "modes_figure",
            "quality_figure",
            "spectrum_figure",
        ),
        "report.figures.population_figures": (
            "b_plane",
            "b_space",
            "coefficients_spread",
            "density_figure",
            "distributions_figure",
            "levels_figure",
            "over_time_figure",
            "scatter_matrix",
        ),
        "cohort.orientation": ("oriented",),
        "report.inputs.saved_fits": ("Coefficients", "StagedFit"),
    },
)
