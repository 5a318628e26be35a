"""Joint offsets that put a deflected end effector back to where it were if the links were rigid."""
