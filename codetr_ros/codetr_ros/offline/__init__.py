"""Reward models from bags: fitted, judged and put to use without any node and without ROS."""
