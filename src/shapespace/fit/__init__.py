"""Fitting of a shape model to one scan.

Entry points: `fit_scan.fit_scan`, `result.FitResult`, `method_choices`. Imported by `correspondence`,
`recognise`, `statistics`, `batch`, `report` and above; a fit reads no file and prints nothing.
"""
