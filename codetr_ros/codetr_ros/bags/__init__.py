"""Bags: MCAP files in the layout of `ros2 bag`, which its tools, rosbags and Foxglove open. No ROS
needed.
"""
