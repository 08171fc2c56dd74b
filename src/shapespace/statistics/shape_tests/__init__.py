"""Tests of shape beyond linear models: one table (`test_table`) drives the commands, the reports and the page.

Each test is a function of a cohort in `groups`, `linear`, `covariation` or `phylogenetic`, and returns a
`ShapeTestResult`.
"""
