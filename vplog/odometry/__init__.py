"""Odometry from images and an IMU: tracking, bundle adjustment, metric scale, and IMU pre-integration."""
