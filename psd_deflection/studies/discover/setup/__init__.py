"""What is wrong with a recording's set-up, before and beside the physics."""
