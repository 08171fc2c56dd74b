"""Completion of partial shapes: the posterior of the whole shape given what a scan shows (docs/completion.md)."""
