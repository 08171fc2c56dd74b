"""The commands that answer questions about cohorts: each module holds the arguments of one, and what runs it."""
