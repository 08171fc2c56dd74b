"""HTML pages, one module per kind of result folder.

Entry point: `write_html.write_report`. Imported by `commands`, `demo` and `viewer`.
"""
