"""Where bytes meet the world: serial ports, recordings, CSV."""
