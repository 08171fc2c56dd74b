"""Recognition of people from scans: similarity scores, and their error rates in verification and identification."""
