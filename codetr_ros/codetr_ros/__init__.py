"""Reinforcement learning from composite delayed rewards: the library behind the ROS 2 nodes."""
