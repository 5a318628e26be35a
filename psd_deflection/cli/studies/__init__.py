"""Commands that study a rig or its recordings."""
