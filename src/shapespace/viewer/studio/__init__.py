"""The studio: a project of scans, from files to reports, in the browser; what it computes are shapespace commands."""
