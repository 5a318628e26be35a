"""The error budget of a rig: what each cause does to dX, dY and theta (thesis chapter 3, corrected)."""
