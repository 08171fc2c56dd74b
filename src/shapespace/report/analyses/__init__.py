"""Reports of statistical analyses: sentences, tables, maps, curves and files made from the results in `statistics`.

Entry points: `result_report.analysis_report` and `result_report.save_analysis`, for the result of any analysis.
May be imported by `report`, `commands` and `cli`.
"""
