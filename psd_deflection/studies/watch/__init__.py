"""Since when a rig is not its model, in a recording: what ``replay --watch`` says, as a study."""
