"""A law for what no effect of the catalogue explains."""
