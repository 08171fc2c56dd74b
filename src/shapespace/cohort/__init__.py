"""Cohorts: shapes of many subjects with covariates, the input of every statistical analysis."""
