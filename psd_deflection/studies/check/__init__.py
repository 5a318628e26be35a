"""Whether a rig is wired and set up as its rig file says, from how the dots answer to known pushes."""
