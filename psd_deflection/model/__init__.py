"""What does physics say? The plate, the link, the detectors, the simulation, and dots back to the pose."""
