"""One job, many scans: fits over files, with results that survive an interruption."""
