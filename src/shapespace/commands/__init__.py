"""The commands of the command line as plain functions; `cli` only parses and prints."""
