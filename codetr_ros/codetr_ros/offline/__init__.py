"""Fit, judge and use reward models on bags, without any node and without ROS."""
