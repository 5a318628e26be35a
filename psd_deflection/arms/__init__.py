"""What do arms of such links do? Links in series, joint offsets, shaped motions."""
