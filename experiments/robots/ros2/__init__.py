"""The ROS 2 node beside real `rclpy` nodes, which run in an environment of their own."""
