"""From dots to the pose of the tip: one algorithm a file, one interface (``_interface``)."""
