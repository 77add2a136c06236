"""Raw messages to images, calibrations, poses and fixes."""
