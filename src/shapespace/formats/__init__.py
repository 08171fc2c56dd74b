"""Shape models in the formats of other tools: one module for each, and all of them in `registry`."""
