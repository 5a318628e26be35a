"""What the simulation is missing: compare, localise, screen, fit, select, report."""
