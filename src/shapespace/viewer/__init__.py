"""Shape models and fits in the browser; a dropped scan is fitted by the same call as the command line."""
