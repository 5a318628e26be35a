"""The rig in numbers: load history to link, optics, detectors and electronics."""
