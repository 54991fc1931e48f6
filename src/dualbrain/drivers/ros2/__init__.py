"""The safety filter as a ROS 2 node, over DDS and without a ROS installation (extra `ros2`).

The core (`command_filter` and the modules that it imports) knows neither DDS nor a clock; `dds_node` connects it.
"""
