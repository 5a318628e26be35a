"""Commands of a running rig."""
