"""Views of results in a notebook: a picture, the key numbers, tables.

Entry points: `notebook_fits`, `notebook_results`. Imported by name, by `lazy`.
"""
