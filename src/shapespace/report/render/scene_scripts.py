"""Names of the scripts in `report/assets` that draw scenes and widgets in the browser, each group in loading order."""

SCENE_SCRIPTS = tuple(f"scene-{part}.js" for part in (
    "data", "camera", "material", "surfaces", "drawing", "controls", "view", "colours",
))  # fmt: skip
"""Views, shape models and colour bars; they need three.min.js before them."""

WIDGET_SCRIPTS = tuple(f"widget-{part}.js" for part in (
    "parts", "model", "fit", "scatter", "morphospace-drawing", "morphospace",
))  # fmt: skip
"""Views with their controls for reports; they need the scripts of scenes and `Shapespace.colours` before them."""
