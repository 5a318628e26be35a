"""What do recordings tell? One folder a study."""
