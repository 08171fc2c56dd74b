"""Shape models in the formats of other tools: one module per format, and `registry` with all formats."""
