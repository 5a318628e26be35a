"""The link's modes from its own motion, and the input shapers that do not ring them."""
