"""The search for missing effects, and the verdict on what it found."""
