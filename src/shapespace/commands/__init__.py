"""What each command of the command line does, as plain functions; `cli` only parses and prints."""
