"""Pictures of surfaces: renderer, scenes for the browser, thumbnails, palettes.

Entry points: `renderer`, `scene`. Imported by `report.pages`, `report.figures`, `report.notebook` and `viewer`.
"""
