"""Completion of partial shapes: the posterior of the complete shape given a partial scan (docs/completion.md)."""
