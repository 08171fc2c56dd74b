"""The method of the paper: similarity ICP of the mean, then ICP in turn with the projection on the modes.

Entry points: `paper_method.Paper`, `similarity_icp`, `shape_icp`. Imported by `fit.method_choices`; imports nothing
of `fit.robust`.
"""
