"""The numbers of a calibration: model, first estimate, adjustment, choice of terms, result. Judges nothing."""
