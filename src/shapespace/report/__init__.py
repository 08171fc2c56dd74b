"""Pictures, pages and notebook views of saved results; no result is computed here.

Entry points: `pages.write_html.write_report`, `notebook`. Imported by `commands`, `demo` and `viewer`.
"""
