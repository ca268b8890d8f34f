"""Bags: written as MCAP with `ros2 bag`'s own layout, so that its tools, rosbags and Foxglove open
them. No ROS needed.
"""
