"""The steps of a calibration, one file each, and the order in which a bench goes through them."""
