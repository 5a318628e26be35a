"""Record to message field dict and back: one file a message, no logic; serves rclpy and MCAP alike."""
