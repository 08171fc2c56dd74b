"""Reports of statistical analyses: sentences, tables, maps, curves and files made from the results in `statistics`.

Entry points: `results.analysis_report` and `results.save_analysis`, for the result of any analysis.
May be imported by `report`, `commands` and `cli`.
"""
