"""Poses and positions: SE(3), places on earth, trajectories as TUM files; and masked parts of images."""
