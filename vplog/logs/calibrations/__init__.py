"""Files of calibration tools and data sets: each kind becomes a list of CalibratedCamera."""
