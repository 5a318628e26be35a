"""The ROS 2 node: the only subpackage that imports rclpy."""
