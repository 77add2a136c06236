"""Pictures of keyframes, boxes, closures and trajectories."""
