"""What is the rig? Every parameter, once; rig files; the rig made of them; its wiring."""
