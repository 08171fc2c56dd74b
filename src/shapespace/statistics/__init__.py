"""Answers about cohorts: who is it, do groups differ, what changed, how symmetric, where in a population."""
