"""The wire of ROS 2: its types, its QoS, and two transports, `rmw_zenoh` and `dds`. A library.

It may import bus, config and host; zenoh, rosbags and cyclonedds are imported here only.
The gateway, drivers of ROS 2 robots, commands and qa may import it. It knows no robot.
"""
