"""The studies of `mitsuba-diffraction benchmark`: speed against error."""
