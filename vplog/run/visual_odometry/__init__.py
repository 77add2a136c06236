"""Odometry by images: corners tracked from frame to frame, poses and landmarks adjusted together."""
