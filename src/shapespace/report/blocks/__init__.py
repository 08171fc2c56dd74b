"""Parts of pages without drawing: text, tables, sections, and the English of settings and evidence.

Entry points: `blocks`, `sections`. Imported by `report.pages`, `report.analyses` and `report.notebook`.
"""
