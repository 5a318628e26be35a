"""The thesis's target, three white discs: found, fitted at the rims, judged."""
