"""What each command of the command line does, as plain functions; `cli.py` only parses and prints."""
