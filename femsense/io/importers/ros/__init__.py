"""Bags of ROS 1 and ROS 2: opening, choosing topics, planning, reading frame by frame."""
