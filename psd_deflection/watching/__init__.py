"""Whether the rig is still what its model says, while it runs."""
